//! For tests only: an allocator that counts, to show that a step of the loop allocates nothing.
//!
//! A test installs it for its own program and counts the heap allocations of a piece of work on the calling thread:
//! ```
//! use cellpos_counting_alloc::{CountingAllocator, allocations_of};
//!
//! #[global_allocator]
//! static ALLOCATOR: CountingAllocator = CountingAllocator;
//!
//! assert_eq!(allocations_of(|| drop(std::hint::black_box(vec![1_u8; 64]))), 1);
//! assert_eq!(allocations_of(|| assert_eq!(std::hint::black_box(2) + 2, 4)), 0);
//! ```
//! Without the `global_allocator` the count stays zero. So a test that asserts a count of zero must also show a count above zero.
//! Frees are not counted. To find where an allocation comes from, stop a debugger in [`CountingAllocator`]'s `alloc`.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator with a count of allocations per thread; for `#[global_allocator]`.
#[derive(Debug, Clone, Copy, Default)]
pub struct CountingAllocator;

// SAFETY: every call goes unchanged to the system's allocator, whose guarantees hold here, too. The counter is a thread-local
// number without lazy initialisation and destructor, so counting can neither allocate nor panic. `realloc` and `alloc_zeroed` are
// those of the trait, which come back to `alloc`: they count as allocations.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = COUNT.try_with(|count| count.set(count.get().wrapping_add(1)));
        // SAFETY: the caller's promise about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: `pointer` came from `System.alloc` with this `layout`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Allocations of the calling thread so far.
pub fn allocations() -> u64 {
    COUNT.with(Cell::get)
}

/// Allocations that a piece of work makes on the calling thread; those of threads that it starts are theirs.
pub fn allocations_of(work: impl FnOnce()) -> u64 {
    let before = allocations();
    work();
    allocations() - before
}
