//! A loop on its threads, and its waiter.

use crate::failure::Failure;
use cellpos_runtime::live::Operator;
use cellpos_runtime::{Request, RunError};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// A running loop that ends in an `F`. On drop it asks the loop to park and waits for it.
pub struct Running<F> {
    operator: Arc<Operator>,
    thread: Option<JoinHandle<Result<F, Failure>>>,
}

impl<F> Running<F> {
    pub(crate) fn new(operator: Arc<Operator>, thread: JoinHandle<Result<F, Failure>>) -> Self {
        Self {
            operator,
            thread: Some(thread),
        }
    }

    /// The handle that requests freeze, park and pause.
    pub fn operator(&self) -> &Arc<Operator> {
        &self.operator
    }

    /// Whether it has come to its end.
    pub fn is_over(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// The run could not be carried through; the PZT is parked.
    pub fn wait(self) -> Result<F, Failure> {
        self.wait_with(Duration::from_secs(3600), || {})
    }

    /// Waits for its end, and calls a function from time to time.
    ///
    /// # Errors
    /// The run could not be carried through; the PZT is parked.
    pub fn wait_with(mut self, every: Duration, mut meanwhile: impl FnMut()) -> Result<F, Failure> {
        const LOOK_EVERY: Duration = Duration::from_millis(5);
        let Some(thread) = self.thread.take() else {
            return Err(panicked());
        };
        let guard = ParkOnPanic(&self.operator);
        let mut next = std::time::Instant::now() + every;
        let mut told = false;
        while !thread.is_finished() {
            std::thread::sleep(LOOK_EVERY);
            // A recorder that hangs delays the end of the run: name it now.
            if let Some(fault) = self.operator.recorder_fault().filter(|_| !told) {
                tracing::error!("{}", fault.sentence());
                told = true;
            }
            if std::time::Instant::now() >= next {
                meanwhile();
                next = std::time::Instant::now() + every;
            }
        }
        std::mem::forget(guard);
        thread.join().unwrap_or_else(|_| Err(panicked()))
    }
}

/// Parks if the thread that waits for a run panics.
struct ParkOnPanic<'a>(&'a Operator);

impl Drop for ParkOnPanic<'_> {
    fn drop(&mut self) {
        self.0.ask(Request::Park);
    }
}

fn panicked() -> Failure {
    Failure::failed(RunError::Panicked { thread: "session" })
}

impl<F> Drop for Running<F> {
    fn drop(&mut self) {
        if let Some(thread) = self.thread.take() {
            self.operator.ask(Request::Park);
            let _ = thread.join();
        }
    }
}
