//! Several simulated runs at once: `--parallel N` of the tables.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Value of `--NAME VALUE` or `--NAME=VALUE` among the arguments of the program; `default` where it is not there.
///
/// # Panics
/// A value that is no number: the table would be another than was asked for.
pub fn option(name: &str, default: u64) -> u64 {
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let given = match argument.strip_prefix(name) {
            Some("") => arguments.next(),
            Some(rest) => rest.strip_prefix('=').map(str::to_string),
            None => None,
        };
        if let Some(given) = given {
            return given
                .parse()
                .unwrap_or_else(|_| panic!("{name} {given}: not a whole number"));
        }
    }
    default
}

/// Threads that `--parallel` asks for; 1 where it is not there, all cores for 0.
pub fn threads() -> usize {
    match option("--parallel", 1) {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        n => usize::try_from(n).unwrap_or(1),
    }
}

/// `of` of every item, in the order of the items, whatever the number of threads.
pub fn map<T: Sync, R: Send>(threads: usize, items: &[T], of: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let done = Mutex::new(Vec::with_capacity(items.len()));
    std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, items.len().max(1)) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_items_whatever_the_number_of_threads() {
        let items: Vec<u64> = (0..100).collect();
        for threads in [1, 3, 200] {
            assert_eq!(
                map(threads, &items, |i| i * i),
                items.iter().map(|i| i * i).collect::<Vec<_>>()
            );
        }
        assert!(map(4, &[] as &[u64], |i| *i).is_empty());
    }
}
