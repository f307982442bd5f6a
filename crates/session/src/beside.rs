//! The CPUs for threads on which no part of a run waits.

use cellpos_runtime::realtime::allowed_cpus;
use rustix::thread::{CpuSet, sched_setaffinity};

/// Keeps the calling thread off the CPU of the control thread (the last one allowed), if there is another. The thread keeps the
/// ordinary scheduling policy.
pub(crate) fn beside_the_loop() {
    let allowed = allowed_cpus();
    let Some((_, others)) = allowed
        .split_last()
        .filter(|(_, others)| !others.is_empty())
    else {
        return;
    };
    let mut set = CpuSet::new();
    others.iter().for_each(|cpu| set.set(*cpu));
    // If the system refuses, the thread shares all CPUs under the ordinary scheduler, below the loop's threads.
    let _ = sched_setaffinity(None, &set);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_beside_the_loop_leaves_the_last_cpu_alone() {
        let before = allowed_cpus();
        let after = std::thread::spawn(|| {
            beside_the_loop();
            allowed_cpus()
        })
        .join()
        .expect("it ends");
        if before.len() > 1 {
            assert_eq!(after, before[..before.len() - 1]);
        } else {
            assert_eq!(after, before);
        }
    }
}
