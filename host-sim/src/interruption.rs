//! Whether the process is asked to end, for what must not be left as it is.

use anyhow::{Context, Result};
use std::sync::Once;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

/// Becomes true when the process is asked to end, which it then does not by itself.
pub fn interruption() -> Result<&'static AtomicBool> {
    static INTERRUPTED: AtomicBool = AtomicBool::new(false);
    static HANDLER: Once = Once::new();
    let mut set = Ok(());
    HANDLER.call_once(|| set = ctrlc::set_handler(|| INTERRUPTED.store(true, Relaxed)));
    set.context("cannot listen for interruptions")?;
    Ok(&INTERRUPTED)
}
