//! The core of the loop.

mod a_day;
mod command_limits;
mod common;
mod freezes;
mod live_threads;
mod no_allocation;
mod other_law;
mod skipped_ticks;
mod stalls;

/// Counts by thread, so that tests beside each other do not disturb one another.
#[global_allocator]
static ALLOCATOR: cellpos_counting_alloc::CountingAllocator =
    cellpos_counting_alloc::CountingAllocator;
