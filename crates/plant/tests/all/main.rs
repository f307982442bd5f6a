//! The chain from command to position.

mod allocation;
mod discretisation;
mod effects;
mod effects_page;
mod hidden_effects;
mod noise;
mod paper;
mod physical;

/// Counts by thread, so that parallel tests do not disturb one another.
#[global_allocator]
static ALLOCATOR: cellpos_counting_alloc::CountingAllocator =
    cellpos_counting_alloc::CountingAllocator;
