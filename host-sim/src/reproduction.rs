//! x
use anyhow::Result; use indicatif::ProgressBar;
pub fn run(_p: &dyn Fn(u64)->ProgressBar) -> Result<()> { Ok(()) }
