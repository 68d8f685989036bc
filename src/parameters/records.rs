//! Parameters as bytes, readable by other versions of the firmware: a record for each, which is found by the CRC-32 of its name.
//!
//! What a firmware does not know it ignores; what it does not find it leaves as it is. A variant that is not the one that was there begins
//! with nothing set: no controller ever sees another one's gains. A variant that it does not know makes the whole unreadable: what was
//! there instead would run with the other parameters, which are not for it.

use crate::checksum::CRC_32;
use crate::schema::{Parameter, Value, walk};

/// Bytes of a record: its key, then the bits of a number, or the CRC-32 of a name.
const RECORD: usize = 8;

/// Writes a parameter and all under it; gives the bytes that this took, nothing if there was no room.
pub fn write(parameter: &mut dyn Parameter, bytes: &mut [u8]) -> Option<usize> {
    let (places, _) = bytes.as_chunks_mut::<RECORD>();
    let mut places = places.iter_mut();
    let mut written = Some(0);
    walk(parameter, &mut |path, parameter| {
        if let Some(value) = parameter.get() {
            match places.next() {
                Some(place) => *place = record(path, value),
                None => written = None,
            }
            written = written.map(|length| length + RECORD);
        }
        true
    });
    written
}

/// Reads a parameter and all under it from records; tells whether all values fit.
pub fn read(parameter: &mut dyn Parameter, records: &[u8]) -> bool {
    let (records, _) = records.as_chunks::<RECORD>();
    let mut fits = true;
    walk(parameter, &mut |path, parameter| {
        if parameter.get().is_none() {
            return true;
        }
        let name = parameter.names().iter().find(|name| {
            let wanted = record(path, Value::Name(name));
            records.contains(&wanted)
        });
        fits &= name.is_some() || parameter.names().is_empty() || !has_name(path, records);
        let value = name.map(|name| Value::Name(name)).or_else(|| number(path, records));
        value.is_some_and(|value| {
            let is_set = parameter.set(value);
            fits &= is_set || !parameter.names().is_empty();
            is_set
        })
    });
    fits
}

fn record(path: &str, value: Value) -> [u8; RECORD] {
    let (kind, value) = match value {
        Value::Number(number) => (NUMBER, number.to_bits()),
        Value::Name(name) => (NAME, CRC_32.checksum(name.as_bytes())),
    };
    let mut record = [0; RECORD];
    let (key, bits) = record.split_at_mut(4);
    key.copy_from_slice(&key_of(path, kind));
    bits.copy_from_slice(&value.to_le_bytes());
    record
}

const NUMBER: u8 = b'#';
const NAME: u8 = b'=';

/// Of a path whose value is of this kind: values of other kinds are other parameters.
fn key_of(path: &str, kind: u8) -> [u8; 4] {
    let mut digest = CRC_32.digest();
    digest.update(path.as_bytes());
    digest.update(&[kind]);
    digest.finalize().to_le_bytes()
}

fn has_name(path: &str, records: &[[u8; RECORD]]) -> bool {
    let key = key_of(path, NAME);
    records.iter().any(|record| record.starts_with(&key))
}

fn number(path: &str, records: &[[u8; RECORD]]) -> Option<Value<'static>> {
    let wanted = key_of(path, NUMBER);
    let found = records.iter().find_map(|record| record.strip_prefix(&wanted))?;
    Some(Value::Number(f32::from_bits(u32::from_le_bytes(*found.first_chunk()?))))
}
