//! State that is handed to an interrupt once, and is the interrupt's alone from then on.
#![allow(unsafe_code, reason = "shared without a lock, in turn")]

use core::cell::UnsafeCell;

/// Holds nothing until it is handed over.
pub(super) struct HandedOver<T>(UnsafeCell<Option<T>>);

// SAFETY: written only before the interrupt is enabled, used only by the interrupt afterwards; see the methods.
unsafe impl<T: Send> Sync for HandedOver<T> {}

impl<T> HandedOver<T> {
    pub const fn new() -> Self {
        Self(UnsafeCell::new(None))
    }

    /// Hands the state over.
    ///
    /// # Safety
    /// The interrupt must still be masked.
    pub unsafe fn hand_over(&self, state: T) {
        // SAFETY: the caller sees to it that there is no other user.
        unsafe { *self.0.get() = Some(state) }
    }

    /// The state, if it was handed over.
    ///
    /// # Safety
    /// Only for the interrupt's handler, once in each call.
    #[inline]
    #[allow(clippy::mut_from_ref, reason = "the one user is the interrupt, which does not nest")]
    pub unsafe fn state(&self) -> Option<&mut T> {
        // SAFETY: the caller is the only user.
        unsafe { (*self.0.get()).as_mut() }
    }
}
