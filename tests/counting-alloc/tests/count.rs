//! Which calls count as an allocation, and of which thread.
#![forbid(unsafe_code)]

use cellpos_counting_alloc::{CountingAllocator, allocations_of};
use std::hint::black_box;
use std::sync::{Arc, Barrier};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

#[test]
fn making_growing_and_zeroing_count_and_freeing_does_not() {
    assert_eq!(allocations_of(|| drop(black_box(vec![1_u8; 64]))), 1);
    assert_eq!(allocations_of(|| drop(black_box(vec![0_u8; 64]))), 1);
    let mut growing = Vec::<u8>::with_capacity(8);
    assert_eq!(allocations_of(|| black_box(&mut growing).reserve(1000)), 1);
    assert_eq!(allocations_of(|| drop(black_box(growing))), 0);
}

#[test]
fn what_another_thread_allocates_meanwhile_is_counted_there_and_not_here() {
    let barrier = Arc::new(Barrier::new(2));
    let theirs = Arc::clone(&barrier);
    let other = std::thread::spawn(move || {
        theirs.wait();
        let count = allocations_of(|| {
            for n in 1..=100 {
                drop(black_box(vec![1_u8; n]));
            }
        });
        theirs.wait();
        count
    });
    let ours = allocations_of(|| {
        barrier.wait();
        barrier.wait();
    });
    assert_eq!(ours, 0);
    assert_eq!(other.join().unwrap(), 100);
}
