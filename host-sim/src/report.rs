//! x
use anyhow::Result;
pub fn summary(_r: &()) -> String { String::new() }
pub fn html(_r: &()) -> Result<String> { Ok(String::new()) }
