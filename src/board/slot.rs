//! One value on its way between a task and an interrupt, either way, without a lock: nobody ever waits.
#![allow(unsafe_code, reason = "a cell that its state guards")]

use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::sync::atomic::{AtomicU8, Ordering};

const EMPTY: u8 = 0;
const FULL: u8 = 1;
/// Somebody is at it.
const BUSY: u8 = 2;

/// Holds a value or none.
pub(super) struct Slot<T> {
    state: AtomicU8,
    value: UnsafeCell<MaybeUninit<T>>,
}

// SAFETY: only who has changed the state to BUSY touches the value, and nobody else can until they change it on.
unsafe impl<T: Send> Sync for Slot<T> {}

impl<T> Slot<T> {
    pub const fn new() -> Self {
        Self { state: AtomicU8::new(EMPTY), value: UnsafeCell::new(MaybeUninit::uninit()) }
    }

    /// Puts a value in, unless there is one; tells whether it did.
    #[inline]
    pub fn put(&self, value: T) -> bool {
        let is_ours = self.claim(EMPTY);
        if is_ours {
            // SAFETY: the state is BUSY, by this call.
            unsafe { (*self.value.get()).write(value) };
            self.state.store(FULL, Ordering::Release);
        }
        is_ours
    }

    /// Puts a value in that may not come about: for one that is too large to be moved about. If there is one already, that stays.
    #[inline]
    pub fn fill<E>(&self, make: impl FnOnce() -> Result<T, E>) -> Result<(), E> {
        if !self.claim(EMPTY) {
            return Ok(());
        }
        let made = make().map(|value| {
            // SAFETY: the state is BUSY, by this call.
            unsafe { (*self.value.get()).write(value) };
        });
        self.state.store(if made.is_ok() { FULL } else { EMPTY }, Ordering::Release);
        made
    }

    /// Takes the value out, if there is one.
    #[inline]
    pub fn take(&self) -> Option<T> {
        if !self.claim(FULL) {
            return None;
        }
        // SAFETY: the state is BUSY, by this call, and was FULL: a value was written, and it is not read again.
        let value = unsafe { (*self.value.get()).assume_init_read() };
        self.state.store(EMPTY, Ordering::Release);
        Some(value)
    }

    /// Lends the value where it is, if there is one: for one that is too large to be moved about.
    #[inline]
    pub fn lend<R>(&self, user: impl FnOnce(&mut T) -> R) -> Option<R> {
        if !self.claim(FULL) {
            return None;
        }
        // SAFETY: the state is BUSY, by this call, and was FULL: a value was written.
        let result = user(unsafe { (*self.value.get()).assume_init_mut() });
        self.state.store(FULL, Ordering::Release);
        Some(result)
    }

    /// Ends the value where it is, if there is one.
    #[inline]
    pub fn discard(&self) {
        if self.claim(FULL) {
            // SAFETY: the state is BUSY, by this call, and was FULL: a value was written. It is not read again.
            unsafe { (*self.value.get()).assume_init_drop() };
            self.state.store(EMPTY, Ordering::Release);
        }
    }

    /// Whether there is a value, which is cheaper to ask than to take one.
    #[inline]
    pub fn is_full(&self) -> bool {
        self.state.load(Ordering::Relaxed) == FULL
    }

    fn claim(&self, state: u8) -> bool {
        let claimed =
            self.state.compare_exchange(state, BUSY, Ordering::Acquire, Ordering::Relaxed);
        claimed.is_ok()
    }
}
