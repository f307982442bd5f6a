//! The laws in closed loop.

mod adaptation;
mod allocation;
mod apart;
mod badly_scaled;
mod common;
mod disturbed;
mod late_ticks;
mod learning;
mod learning_beside_adaptation;
mod limits;
mod multi_rate;
mod periodic;
mod pi_loop;
mod solvers;
mod state_feedback;
mod stuck_bead;
mod uneven;
mod wandering_flow;

/// Counts by thread, so that tests beside each other do not disturb one another.
#[global_allocator]
static ALLOCATOR: cellpos_counting_alloc::CountingAllocator =
    cellpos_counting_alloc::CountingAllocator;
