//! Queue of one client: bounded, the oldest message is dropped first.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;
use tungstenite::Message;

/// Messages that wait for a client: about two seconds' worth.
const MESSAGES: usize = 100;

/// Messages that wait for a client. If it is full, the oldest message is dropped and counted.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    waiting: Mutex<VecDeque<Message>>,
    come: Condvar,
    lost: AtomicU64,
    closed: AtomicBool,
    told: AtomicBool,
}

impl Queue {
    /// Adds a message.
    pub(crate) fn push(&self, message: &Message) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.len() == MESSAGES {
            waiting.pop_front();
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
        waiting.push_back(message.clone());
        self.come.notify_one();
    }

    /// All that waits.
    #[cfg(test)]
    pub(crate) fn take(&self) -> Vec<Message> {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.drain(..).collect()
    }

    /// The oldest waiting message, or none after `most`.
    pub(crate) fn next(&self, most: Duration) -> Option<Message> {
        let waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut waiting, _) = self
            .come
            .wait_timeout_while(waiting, most, |waiting| waiting.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        waiting.pop_front()
    }

    /// Messages that went unread.
    pub(crate) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Marks the client as gone.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Whether the client has left.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Whether this is the first call.
    pub(crate) fn is_new(&self) -> bool {
        !self.told.swap(true, Ordering::AcqRel)
    }
}
