//! Pictures, rendered and recorded, through localiser and trackers.

mod beside_a_wall;
mod beside_specks;
mod bound;
mod cell_lab;
mod cell_table;
mod cells;
mod common;
mod detector;
mod learnt;
mod measured_beads;
mod membranes;
mod no_allocation;
mod range;
mod real_cells;
mod smeared;
mod streak;
mod stress;
mod stress_scene;
mod stress_table;
mod suggested;
mod touching;
mod tracking;
mod uncertainty;
mod walls;

/// Counts by thread, so that tests beside each other do not disturb one another.
#[global_allocator]
static ALLOCATOR: cellpos_counting_alloc::CountingAllocator =
    cellpos_counting_alloc::CountingAllocator;
