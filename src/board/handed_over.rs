//! State that is handed to an interrupt once, and is the interrupt's alone from then on.
#![allow(unsafe_code, reason = "shared without a lock, in turn")]

use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

/// Holds nothing until it is handed over.
// Not an option: where none is not all zeros, flash holds an image of the whole.
pub(super) struct HandedOver<T> {
    is_there: UnsafeCell<bool>,
    state: UnsafeCell<MaybeUninit<T>>,
}

// SAFETY: written only before the interrupt is enabled, used only by the interrupt afterwards; see the methods.
unsafe impl<T: Send> Sync for HandedOver<T> {}

impl<T> HandedOver<T> {
    pub const fn new() -> Self {
        Self { is_there: UnsafeCell::new(false), state: UnsafeCell::new(MaybeUninit::uninit()) }
    }

    /// Hands the state over; gives it for last touches.
    ///
    /// # Safety
    /// The interrupt must still be masked, and what is given no longer be used when it no longer is.
    #[inline]
    #[allow(clippy::mut_from_ref, reason = "there is no other user yet")]
    pub unsafe fn hand_over(&self, state: T) -> &mut T {
        // SAFETY: the caller sees to it that there is no other user.
        unsafe {
            *self.is_there.get() = true;
            (*self.state.get()).write(state)
        }
    }

    /// The state, if it was handed over.
    ///
    /// # Safety
    /// Only for the interrupt's handler, once in each call.
    #[inline]
    #[allow(clippy::mut_from_ref, reason = "the one user is the interrupt, which does not nest")]
    pub unsafe fn state(&self) -> Option<&mut T> {
        // SAFETY: the caller is the only user, and what is there was written.
        unsafe { (*self.is_there.get()).then(|| (*self.state.get()).assume_init_mut()) }
    }
}
