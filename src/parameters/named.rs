//! Structured values as named ones, and back: what makes a saved set readable to other versions of the firmware.
//!
//! Any `serde` structure of structs, enums, options, numbers and flags becomes a list of dotted paths with a [`Value`] each:
//!
//! ```text
//! limits           (a group)            control                           Drive
//! limits.duty      0.92                 control.Drive                     (a group)
//! limits.speed     400.0                control.Drive.observer_bandwidth  1170.0
//! ```
//!
//! A struct is a group, with its fields under its path. An enum is the name of its variant, with what that holds under this
//! name; an option is the name `none`, or what it holds. Reading looks values up by path, so their order does not matter, nor
//! do others among them. Where none is found, serde's own `default` attributes apply.

use core::fmt;
use heapless::String;
use serde::de::value::U32Deserializer;
use serde::de::{self, DeserializeSeed, IntoDeserializer, SeqAccess, Visitor};
use serde::ser::{self, Impossible};
use serde::{Deserialize, Serialize};

/// Longest path, in bytes.
pub const LONGEST_PATH: usize = 64;

/// Name of an option that holds nothing.
const NONE: &str = "none";

/// What stands at a path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Value<'a> {
    /// A struct, whose fields have paths of their own.
    Group,
    /// A number, in the SI unit that its field documents.
    Number(f32),
    /// A whole number.
    Integer(i64),
    /// Yes or no.
    Flag(bool),
    /// The name of an enum's variant, or `none`.
    Name(&'a str),
}

/// Why a structure could not be written or read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Error {
    /// A field has a type that has no name or value here, or a path that is too long.
    Unsupported,
    /// The values ended up where there was no room for them.
    Full,
    /// A value is missing, or not one that its field can have.
    Unreadable,
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Unsupported => "a field that cannot be a named value",
            Self::Full => "no room for all values",
            Self::Unreadable => "a value is missing or does not fit its field",
        })
    }
}

impl core::error::Error for Error {}

impl ser::Error for Error {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Unsupported
    }
}

impl de::Error for Error {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Unreadable
    }
}

/// Where named values go.
pub type Sink<'a> = dyn FnMut(&str, Value<'static>) -> Result<(), Error> + 'a;

/// Where named values come from: the first at a path that is acceptable to the test.
pub type Source<'a, 'de> = dyn Fn(&str, &dyn Fn(&Value) -> bool) -> Option<Value<'de>> + 'a;

/// Tells `sink` all values of a structure, their paths beginning with `root`.
pub fn write(root: &str, structure: &impl Serialize, sink: &mut Sink) -> Result<(), Error> {
    structure.serialize(&mut Writer { path: path(root)?, sink })
}

/// Reads a structure from values whose paths begin with `root`.
pub fn read<'de, T: Deserialize<'de>>(root: &str, source: &Source<'_, 'de>) -> Result<T, Error> {
    T::deserialize(&mut Reader { path: path(root)?, source })
}

type Path = String<LONGEST_PATH>;

fn path(text: &str) -> Result<Path, Error> {
    Path::try_from(text).map_err(|_| Error::Unsupported)
}

/// Appends a field to a path; gives the length to go back to.
// Like others here not inlined: serde's code calls it for each field of each type.
#[inline(never)]
fn enter(path: &mut Path, field: &str) -> Result<usize, Error> {
    let length = path.len();
    if length > 0 {
        path.push('.').map_err(|_| Error::Unsupported)?;
    }
    path.push_str(field).map_err(|_| Error::Unsupported)?;
    Ok(length)
}

struct Writer<'a, 's> {
    path: Path,
    sink: &'a mut Sink<'s>,
}

impl Writer<'_, '_> {
    #[inline(never)]
    fn put(&mut self, value: Value<'static>) -> Result<(), Error> {
        (self.sink)(&self.path, value)
    }
}

/// A type of serde's that is none of the kinds of [`Value`].
macro_rules! unsupported {
    ($($method:ident($($argument:ty),*) -> $ok:ty;)*) => {
        $(fn $method(self, $(_: $argument),*) -> Result<$ok, Error> {
            Err(Error::Unsupported)
        })*
    };
}

macro_rules! integers {
    ($($method:ident: $integer:ty),*) => {
        $(fn $method(self, value: $integer) -> Result<(), Error> {
            self.put(Value::Integer(value.into()))
        })*
    };
}

impl<'w, 'a, 's> ser::Serializer for &'w mut Writer<'a, 's> {
    type Ok = ();
    type Error = Error;
    type SerializeSeq = Impossible<(), Error>;
    type SerializeTuple = Impossible<(), Error>;
    type SerializeTupleStruct = Impossible<(), Error>;
    type SerializeTupleVariant = Impossible<(), Error>;
    type SerializeMap = Impossible<(), Error>;
    type SerializeStruct = Self;
    type SerializeStructVariant = VariantWriter<'w, 'a, 's>;

    fn serialize_f32(self, value: f32) -> Result<(), Error> {
        self.put(Value::Number(value))
    }

    fn serialize_bool(self, value: bool) -> Result<(), Error> {
        self.put(Value::Flag(value))
    }

    integers! {
        serialize_i8: i8, serialize_i16: i16, serialize_i32: i32, serialize_i64: i64,
        serialize_u8: u8, serialize_u16: u16, serialize_u32: u32
    }

    fn serialize_none(self) -> Result<(), Error> {
        self.put(Value::Name(NONE))
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), Error> {
        value.serialize(self)
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Self, Error> {
        self.put(Value::Group)?;
        Ok(self)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        value.serialize(self)
    }

    fn serialize_unit_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
    ) -> Result<(), Error> {
        self.put(Value::Name(variant))
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        self.put(Value::Name(variant))?;
        let length = enter(&mut self.path, variant)?;
        value.serialize(&mut *self)?;
        self.path.truncate(length);
        Ok(())
    }

    fn serialize_struct_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        _: usize,
    ) -> Result<Self::SerializeStructVariant, Error> {
        self.put(Value::Name(variant))?;
        let length = enter(&mut self.path, variant)?;
        Ok(VariantWriter { writer: self, length })
    }

    unsupported! {
        serialize_u64(u64) -> ();
        serialize_f64(f64) -> ();
        serialize_char(char) -> ();
        serialize_str(&str) -> ();
        serialize_bytes(&[u8]) -> ();
        serialize_unit() -> ();
        serialize_unit_struct(&'static str) -> ();
        serialize_seq(Option<usize>) -> Self::SerializeSeq;
        serialize_tuple(usize) -> Self::SerializeTuple;
        serialize_tuple_struct(&'static str, usize) -> Self::SerializeTupleStruct;
        serialize_tuple_variant(&'static str, u32, &'static str, usize) -> Self::SerializeTupleVariant;
        serialize_map(Option<usize>) -> Self::SerializeMap;
    }

    fn collect_str<T: fmt::Display + ?Sized>(self, _: &T) -> Result<(), Error> {
        Err(Error::Unsupported)
    }
}

impl ser::SerializeStruct for &mut Writer<'_, '_> {
    type Ok = ();
    type Error = Error;

    #[inline(never)]
    fn serialize_field<T: Serialize + ?Sized>(
        &mut self,
        field: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        let length = enter(&mut self.path, field)?;
        value.serialize(&mut **self)?;
        self.path.truncate(length);
        Ok(())
    }

    fn end(self) -> Result<(), Error> {
        Ok(())
    }
}

/// A variant with fields, which leaves its path at the end.
struct VariantWriter<'w, 'a, 's> {
    writer: &'w mut Writer<'a, 's>,
    /// Of the enum's own path.
    length: usize,
}

impl ser::SerializeStructVariant for VariantWriter<'_, '_, '_> {
    type Ok = ();
    type Error = Error;

    fn serialize_field<T: Serialize + ?Sized>(
        &mut self,
        field: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        ser::SerializeStruct::serialize_field(&mut self.writer, field, value)
    }

    fn end(self) -> Result<(), Error> {
        self.writer.path.truncate(self.length);
        Ok(())
    }
}

struct Reader<'a, 'de> {
    path: Path,
    source: &'a Source<'a, 'de>,
}

impl<'de> Reader<'_, 'de> {
    #[inline(never)]
    fn find(&self, accept: &dyn Fn(&Value) -> bool) -> Result<Value<'de>, Error> {
        (self.source)(&self.path, accept).ok_or(Error::Unreadable)
    }

    #[inline(never)]
    fn number(&self) -> Result<f32, Error> {
        match self.find(&|value| matches!(value, Value::Number(_)))? {
            Value::Number(number) => Ok(number),
            _ => Err(Error::Unreadable),
        }
    }

    #[inline(never)]
    fn integer(&self) -> Result<i64, Error> {
        match self.find(&|value| matches!(value, Value::Integer(_)))? {
            Value::Integer(integer) => Ok(integer),
            _ => Err(Error::Unreadable),
        }
    }
}

impl Reader<'_, '_> {
    /// Enters the variant that is named; gives its index and the length of the path to go back to.
    #[inline(never)]
    fn enter_variant(&mut self, variants: &[&str]) -> Result<(u32, usize), Error> {
        let index = |value: &Value| match value {
            Value::Name(name) => variants.iter().position(|variant| variant == name),
            _ => None,
        };
        let found = self.find(&|value| index(value).is_some())?;
        let index = index(&found).ok_or(Error::Unreadable)?;
        let variant = variants.get(index).ok_or(Error::Unreadable)?;
        Ok((index as u32, enter(&mut self.path, variant)?))
    }
}

macro_rules! deserialize_integers {
    ($($method:ident)*) => {
        $(fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
            visitor.visit_i64(self.integer()?)
        })*
    };
}

impl<'de> de::Deserializer<'de> for &mut Reader<'_, 'de> {
    type Error = Error;

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_f32(self.number()?)
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        match self.find(&|value| matches!(value, Value::Flag(_)))? {
            Value::Flag(flag) => visitor.visit_bool(flag),
            _ => Err(Error::Unreadable),
        }
    }

    deserialize_integers! {
        deserialize_i8 deserialize_i16 deserialize_i32 deserialize_i64
        deserialize_u8 deserialize_u16 deserialize_u32
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        match self.find(&|_| true)? {
            Value::Name(NONE) => visitor.visit_none(),
            _ => visitor.visit_some(self),
        }
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        visitor.visit_seq(Fields { reader: self, fields: fields.iter() })
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        visitor: V,
    ) -> Result<V::Value, Error> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        visitor.visit_enum(Variant { reader: self, variants })
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, Error> {
        Err(Error::Unsupported)
    }

    serde::forward_to_deserialize_any! {
        u64 f64 i128 u128 char str string bytes byte_buf unit unit_struct seq tuple tuple_struct map identifier ignored_any
    }
}

/// The fields of a struct, in its order; none in the place of one for which there is no value.
struct Fields<'r, 'a, 'de> {
    reader: &'r mut Reader<'a, 'de>,
    fields: core::slice::Iter<'static, &'static str>,
}

impl Fields<'_, '_, '_> {
    /// Enters the next field, if there is a value for it; gives the length of the path to go back to.
    #[inline(never)]
    fn next(&mut self) -> Result<Option<usize>, Error> {
        let Some(field) = self.fields.next() else { return Ok(None) };
        let length = enter(&mut self.reader.path, field)?;
        if self.reader.find(&|_| true).is_ok() {
            return Ok(Some(length));
        }
        self.reader.path.truncate(length);
        Ok(None)
    }
}

impl<'de> SeqAccess<'de> for Fields<'_, '_, 'de> {
    type Error = Error;

    #[inline(never)]
    fn next_element_seed<T: DeserializeSeed<'de>>(
        &mut self,
        seed: T,
    ) -> Result<Option<T::Value>, Error> {
        let Some(length) = self.next()? else { return Ok(None) };
        let value = seed.deserialize(&mut *self.reader)?;
        self.reader.path.truncate(length);
        Ok(Some(value))
    }
}

/// The variant of an enum that is named at the path.
struct Variant<'r, 'a, 'de> {
    reader: &'r mut Reader<'a, 'de>,
    variants: &'static [&'static str],
}

impl<'r, 'a, 'de> de::EnumAccess<'de> for Variant<'r, 'a, 'de> {
    type Error = Error;
    type Variant = VariantReader<'r, 'a, 'de>;

    fn variant_seed<V: DeserializeSeed<'de>>(
        self,
        seed: V,
    ) -> Result<(V::Value, Self::Variant), Error> {
        let (index, length) = self.reader.enter_variant(self.variants)?;
        let index: U32Deserializer<Error> = index.into_deserializer();
        let variant = seed.deserialize(index)?;
        Ok((variant, VariantReader { reader: self.reader, length }))
    }
}

/// What a variant holds; leaves its path at the end.
struct VariantReader<'r, 'a, 'de> {
    reader: &'r mut Reader<'a, 'de>,
    /// Of the enum's own path.
    length: usize,
}

impl<'de> de::VariantAccess<'de> for VariantReader<'_, '_, 'de> {
    type Error = Error;

    fn unit_variant(self) -> Result<(), Error> {
        self.reader.path.truncate(self.length);
        Ok(())
    }

    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<T::Value, Error> {
        let value = seed.deserialize(&mut *self.reader)?;
        self.reader.path.truncate(self.length);
        Ok(value)
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        let reader = &mut *self.reader;
        let value = visitor.visit_seq(Fields { reader, fields: fields.iter() })?;
        self.reader.path.truncate(self.length);
        Ok(value)
    }

    fn tuple_variant<V: Visitor<'de>>(self, _: usize, _: V) -> Result<V::Value, Error> {
        Err(Error::Unsupported)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A structure as an older firmware has it.
    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Old {
        speed: f32,
        brake: Brake,
        limit: Option<f32>,
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    enum Brake {
        None,
        Chopper { voltage: f32 },
    }

    /// The same as a newer one has it: more fields, in another order.
    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct New {
        brake: NewBrake,
        #[serde(default = "ten")]
        turns: u16,
        limit: Option<f32>,
        speed: f32,
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    enum NewBrake {
        Chopper {
            voltage: f32,
            #[serde(default)]
            hysteresis: Option<f32>,
        },
        None,
    }

    fn ten() -> u16 {
        10
    }

    type Values = heapless::Vec<(Path, Value<'static>), 16>;

    fn values(structure: &impl Serialize) -> Values {
        let mut values = Values::new();
        write("x", structure, &mut |name, value| {
            values.push((path(name)?, value)).map_err(|_| Error::Full)
        })
        .expect("written");
        values
    }

    fn back<T: for<'a> Deserialize<'a>>(values: &Values) -> Result<T, Error> {
        read("x", &|path, accept| {
            let mut found = values.iter().filter(|(name, _)| name == path);
            found.find_map(|(_, value)| Some(*value).filter(accept))
        })
    }

    #[test]
    fn values_have_the_names_of_their_fields() {
        let old = Old { speed: 1.5, brake: Brake::Chopper { voltage: 27.0 }, limit: None };
        let expected = [
            ("x", Value::Group),
            ("x.speed", Value::Number(1.5)),
            ("x.brake", Value::Name("Chopper")),
            ("x.brake.Chopper.voltage", Value::Number(27.0)),
            ("x.limit", Value::Name("none")),
        ];
        let values = values(&old);
        assert!(values.iter().map(|(name, value)| (name.as_str(), *value)).eq(expected));
        assert_eq!(back(&values), Ok(old));
        let other = Old { speed: -1.5, brake: Brake::None, limit: Some(2.0) };
        assert_eq!(back(&self::values(&other)), Ok(other));
    }

    #[test]
    fn versions_read_each_other() {
        let old = Old { speed: 1.5, brake: Brake::Chopper { voltage: 27.0 }, limit: Some(2.0) };
        let new = New {
            brake: NewBrake::Chopper { voltage: 27.0, hysteresis: None },
            turns: 10,
            limit: Some(2.0),
            speed: 1.5,
        };
        assert_eq!(back::<Old>(&values(&new)), Ok(old));
        let old = Old { speed: 1.5, brake: Brake::Chopper { voltage: 27.0 }, limit: Some(2.0) };
        assert_eq!(back::<New>(&values(&old)), Ok(new), "defaults for what is new");
    }

    #[test]
    fn what_has_no_default_must_be_there_and_fit() {
        let old = Old { speed: 1.5, brake: Brake::None, limit: None };
        for index in 1..4 {
            let mut without = values(&old);
            without.remove(index);
            assert_eq!(back::<Old>(&without), Err(Error::Unreadable), "{index}");
            let mut other = values(&old);
            other[index].1 = Value::Name("Regenerative");
            assert_eq!(back::<Old>(&other), Err(Error::Unreadable), "{index}");
        }
        assert_eq!(back::<Old>(&Values::new()), Err(Error::Unreadable));
    }

    #[test]
    fn what_cannot_be_named_is_unsupported() {
        #[derive(Serialize)]
        struct Wide {
            a_name_that_is_as_long_as_the_longest_path_and_then_a_little_more_than_that: bool,
        }
        let nothing: &mut Sink = &mut |_, _| Ok(());
        assert_eq!(write("", &"text", nothing), Err(Error::Unsupported));
        assert_eq!(write("", &[1.0_f32, 2.0], nothing), Err(Error::Unsupported));
        assert_eq!(write("", &1.0_f64, nothing), Err(Error::Unsupported));
        let wide = Wide {
            a_name_that_is_as_long_as_the_longest_path_and_then_a_little_more_than_that: true,
        };
        assert_eq!(write("", &wide, nothing), Err(Error::Unsupported));
        assert_eq!(write("", &1.0_f32, &mut |_, _| Err(Error::Full)), Err(Error::Full));
    }
}
