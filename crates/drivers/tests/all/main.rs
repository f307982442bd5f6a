//! Cameras and recordings as sources of positions.

mod films;
mod published;
mod recordings;
#[cfg(feature = "hdf5")]
mod rtdc;
mod vision_source;

/// Counts by thread, so that parallel tests do not disturb one another.
#[global_allocator]
static ALLOCATOR: cellpos_counting_alloc::CountingAllocator =
    cellpos_counting_alloc::CountingAllocator;
