//! A map over items on a few threads, for fits, folds, or seeds of a table. The result does not depend on the number of threads.
//!
//! Not for a loop: threads are started and joined, and results wait for a lock.
//!
//! ```
//! let squares = cellpos_numeric::parallel::map(&[1, 2, 3], 2, |n| n * n);
//! assert_eq!(squares, [1, 4, 9], "in the order of the items, whatever thread was first");
//! ```
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Applies `of` to every item on `threads` threads (at least one, at most one per item); results in the order of the items.
///
/// ```
/// assert_eq!(cellpos_numeric::parallel::map(&[1, 2, 3], 2, |i| i * i), [1, 4, 9]);
/// ```
///
/// # Panics
/// Where `of` does.
pub fn map<T: Sync, R: Send>(items: &[T], threads: usize, of: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let threads = threads.clamp(1, items.len().max(1));
    if threads == 1 {
        return items.iter().map(of).collect();
    }
    let next = AtomicUsize::new(0);
    let done = Mutex::new(Vec::with_capacity(items.len()));
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some((place, item)) = {
                    let place = next.fetch_add(1, Ordering::Relaxed);
                    items.get(place).map(|item| (place, item))
                } {
                    let result = of(item);
                    done.lock()
                        .unwrap_or_else(PoisonError::into_inner)
                        .push((place, result));
                }
            });
        }
    });
    let mut done = done.into_inner().unwrap_or_else(PoisonError::into_inner);
    done.sort_by_key(|(place, _)| *place);
    done.into_iter().map(|(_, result)| result).collect()
}

/// Number of threads for a requested number: all cores for 0.
pub fn threads(asked: usize) -> usize {
    match asked {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        n => n,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_items_whatever_the_number_of_threads() {
        let items: Vec<u64> = (0..100).collect();
        for threads in [0, 1, 3, 200] {
            assert_eq!(
                map(&items, threads, |i| i * i),
                items.iter().map(|i| i * i).collect::<Vec<_>>()
            );
        }
        assert!(map(&[] as &[u64], 4, |i| *i).is_empty());
    }
}
