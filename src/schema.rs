//! Configurations as trees of named values: the one list of what can be set, which links, flash and hosts share.
//!
//! Each type of a configuration lists its fields once, by `group!` or `choice!`. From that come dotted paths with a [`Value`]
//! each:
//!
//! ```text
//! limits.duty   0.92        control                     Drive
//! limits.speed  400.0       control.observer_bandwidth  1170.0
//! ```
//!
//! A struct is a group, with its fields under its path. An enum is the name of its variant, with what that holds under the same
//! path; a flag is `false` or `true`, an option `none` or its number. So a name's children depend on the values of the names above it,
//! and a variant that is chosen by its name holds nothing usable until its values are set too: its numbers are NaN,
//! which every check refuses, its names the first ones.
//!
//! All of it is behind `dyn`: what reads, writes, stores and sends exists once, not once for each type.

use heapless::String;
use serde::{Deserialize, Serialize};

/// Longest path, in bytes.
pub const LONGEST_PATH: usize = 40;

/// A dotted path.
pub type Path = String<LONGEST_PATH>;

/// What stands at a path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Value<'a> {
    /// A number, in the SI unit that its field documents.
    Number(f32),
    /// One of the field's names.
    Name(&'a str),
}

/// A value as its field has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Content {
    /// None: it is a group.
    Group,
    /// A number.
    Number(f32),
    /// The place of a name among the field's [`names`](Parameter::names).
    Name(usize),
}

/// A field with a value, or a group of such.
pub trait Parameter {
    /// Its value.
    fn content(&self) -> Content;

    /// Sets its value; tells whether it can be so.
    fn set_content(&mut self, content: Content) -> bool;

    /// All names that it can have.
    fn names(&self) -> &'static [&'static str] {
        &[]
    }

    /// Shows what is under it, in an order that is always the same.
    fn visit(&mut self, _: &mut Visitor) {}
}

impl dyn Parameter + '_ {
    /// Its value; none if it is a group.
    pub fn get(&self) -> Option<Value<'static>> {
        match self.content() {
            Content::Group => None,
            Content::Number(number) => Some(Value::Number(number)),
            Content::Name(place) => self.names().get(place).map(|name| Value::Name(name)),
        }
    }

    /// Sets its value; tells whether it can be so.
    pub fn set(&mut self, value: Value) -> bool {
        match value {
            Value::Number(number) => self.set_content(Content::Number(number)),
            Value::Name(wanted) => {
                let place = self.names().iter().position(|name| *name == wanted);
                place.is_some_and(|place| self.set_content(Content::Name(place)))
            }
        }
    }
}

/// Is shown parameters with their names.
pub type Visitor<'a> = dyn FnMut(&'static str, &mut dyn Parameter) + 'a;

/// What a value is before it is set.
pub(crate) trait Unset {
    const UNSET: Self;
}

/// Shows a parameter and all under it to `each`, with their paths; nothing under one for which it says no. What is under a value
/// that `each` sets is of the new one.
pub fn walk(parameter: &mut dyn Parameter, each: &mut dyn FnMut(&str, &mut dyn Parameter) -> bool) {
    descend(parameter, &mut Path::new(), each);
}

fn descend(
    parameter: &mut dyn Parameter,
    path: &mut Path,
    each: &mut dyn FnMut(&str, &mut dyn Parameter) -> bool,
) {
    if each(path, parameter) {
        let length = path.len();
        parameter.visit(&mut |name, parameter| {
            // Paths have room: a test walks them all.
            let _ = if length > 0 { path.push('.') } else { Ok(()) };
            let _ = path.push_str(name);
            descend(parameter, path, each);
            path.truncate(length);
        });
    }
}

/// The name and value that has so many others ahead of it.
pub fn nth(parameter: &mut dyn Parameter, index: usize) -> Option<(Path, Value<'static>)> {
    let mut left = index;
    let mut found = None;
    walk(parameter, &mut |path, parameter| {
        if let (None, Some(value)) = (&found, parameter.get()) {
            match left.checked_sub(1) {
                Some(less) => left = less,
                None => found = Path::try_from(path).ok().map(|path| (path, value)),
            }
        }
        found.is_none()
    });
    found
}

/// Why a value was not set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SetError {
    /// There is no such name, or not with the other values as they are.
    Unknown,
    /// The value is not one that the name can have.
    Unfit,
}

/// Sets the value of a name.
pub fn set(parameter: &mut dyn Parameter, name: &str, value: Value) -> Result<(), SetError> {
    let mut result = Err(SetError::Unknown);
    walk(parameter, &mut |path, parameter| {
        if path == name && parameter.get().is_some() {
            result = if parameter.set(value) { Ok(()) } else { Err(SetError::Unfit) };
        }
        name.starts_with(path)
    });
    result
}

impl Unset for f32 {
    const UNSET: Self = Self::NAN;
}

impl Parameter for f32 {
    fn content(&self) -> Content {
        Content::Number(*self)
    }

    fn set_content(&mut self, content: Content) -> bool {
        let Content::Number(number) = content else { return false };
        *self = number;
        true
    }
}

/// Whole numbers, which are told as numbers.
macro_rules! whole {
    ($($type:ident)*) => {
        $(
            impl Unset for $type {
                const UNSET: Self = 0;
            }

            impl Parameter for $type {
                fn content(&self) -> Content {
                    Content::Number(*self as f32)
                }

                fn set_content(&mut self, content: Content) -> bool {
                    let Content::Number(number) = content else { return false };
                    let is_one = number as Self as f32 == number;
                    if is_one {
                        *self = number as Self;
                    }
                    is_one
                }
            }
        )*
    };
}

whole! { i32 u16 }

impl Unset for bool {
    const UNSET: Self = false;
}

impl Parameter for bool {
    fn content(&self) -> Content {
        Content::Name(usize::from(*self))
    }

    fn set_content(&mut self, content: Content) -> bool {
        let Content::Name(place) = content else { return false };
        *self = place > 0;
        true
    }

    fn names(&self) -> &'static [&'static str] {
        &["false", "true"]
    }
}

impl Unset for Option<f32> {
    const UNSET: Self = None;
}

impl Parameter for Option<f32> {
    fn content(&self) -> Content {
        self.map_or(Content::Name(0), Content::Number)
    }

    fn set_content(&mut self, content: Content) -> bool {
        *self = match content {
            Content::Number(number) => Some(number),
            Content::Name(_) | Content::Group => None,
        };
        true
    }

    fn names(&self) -> &'static [&'static str] {
        &["none"]
    }
}

/// A struct as a group: `group! { Limits { duty, speed } }`.
macro_rules! group {
    ($type:ident { $($field:ident),* $(,)? }) => {
        impl $crate::schema::Unset for $type {
            const UNSET: Self = Self { $($field: $crate::schema::Unset::UNSET),* };
        }

        impl $crate::schema::Group for $type {
            fn fields(&mut self, visitor: &mut $crate::schema::Visitor) {
                let Self { $($field),* } = self;
                $(visitor(stringify!($field), $field);)*
            }
        }
    };
}

/// A struct whose fields are parameters.
pub(crate) trait Group {
    fn fields(&mut self, visitor: &mut Visitor);
}

impl<T: Group> Parameter for T {
    fn content(&self) -> Content {
        Content::Group
    }

    fn set_content(&mut self, _: Content) -> bool {
        false
    }

    fn visit(&mut self, visitor: &mut Visitor) {
        self.fields(visitor);
    }
}

/// An enum as its variant's name, and what that holds: `choice! { Shape { Step, Ramp { slope }, Filtered(filter) } }`.
macro_rules! choice {
    ($type:ident { $($variant:ident $(($group:ident))? $({ $($field:ident),* })?),* $(,)? }) => {
        impl $type {
            const VARIANTS: &'static [Self] = &[$(
                Self::$variant
                    $(({ let $group = $crate::schema::Unset::UNSET; $group }))?
                    $({ $($field: $crate::schema::Unset::UNSET),* })?
            ),*];
        }

        impl $crate::schema::Unset for $type {
            const UNSET: Self = Self::VARIANTS[0];
        }

        impl $crate::schema::Parameter for $type {
            fn content(&self) -> $crate::schema::Content {
                enum Place { $($variant),* }
                $crate::schema::Content::Name(match self {
                    $(Self::$variant { .. } => Place::$variant as usize),*
                })
            }

            fn set_content(&mut self, content: $crate::schema::Content) -> bool {
                let $crate::schema::Content::Name(place) = content else { return false };
                // What it holds already stays.
                if self.content() != content && let Some(variant) = Self::VARIANTS.get(place) {
                    *self = *variant;
                }
                true
            }

            fn names(&self) -> &'static [&'static str] {
                &[$(stringify!($variant)),*]
            }

            #[allow(unused_variables, reason = "there are enums that hold nothing")]
            fn visit(&mut self, visitor: &mut $crate::schema::Visitor) {
                match self {
                    $(Self::$variant $(($group))? $({ $($field),* })? => {
                        $($crate::schema::Parameter::visit($group, visitor);)?
                        $($(visitor(stringify!($field), $field);)*)?
                    })*
                }
            }
        }
    };
}

pub(crate) use {choice, group};
