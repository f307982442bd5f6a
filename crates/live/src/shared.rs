//! Data shared by the server's threads.

use crate::access::{Role, Secrets};
use crate::command::OperatorRequest;
use crate::film::Film;
use crate::hub::Clients;
use crate::state::Hello;
use serde::Serialize;
use std::collections::VecDeque;
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tungstenite::Message;

/// Data shared by the server's threads.
pub(crate) struct Shared {
    pub(crate) secrets: Secrets,
    pub(crate) address: SocketAddr,
    pub(crate) hello: Hello,
    /// The hub sends all waiting data and ends; clients continue until `over`.
    pub(crate) ending: AtomicBool,
    pub(crate) over: AtomicBool,
    pub(crate) clients: Clients,
    pub(crate) connections: AtomicUsize,
    /// Connections without a request yet, oldest first, by number.
    pub(crate) silent: Mutex<VecDeque<(u64, TcpStream)>>,
    pub(crate) command: Box<dyn Fn(OperatorRequest) + Send + Sync>,
    pub(crate) on_thread: Option<Arc<dyn Fn() + Send + Sync>>,
    pub(crate) film: Option<Film>,
}

#[derive(Serialize)]
struct Greeting<'a> {
    pub(crate) hello: &'a Hello,
    operator: bool,
}

impl Shared {
    pub(crate) fn is_over(&self) -> bool {
        self.over.load(Ordering::Acquire)
    }

    pub(crate) fn targets_um(&self) -> [f64; 2] {
        self.hello.targets_um()
    }

    pub(crate) fn ask(&self, command: OperatorRequest) {
        (self.command)(command);
    }

    /// The first message of a client.
    pub(crate) fn hello(&self, role: Role) -> Message {
        let greeting = Greeting {
            hello: &self.hello,
            operator: role == Role::Operator,
        };
        Message::text(serde_json::to_string(&greeting).unwrap_or_default())
    }

    /// Remembers a connection until its request.
    pub(crate) fn await_word(&self, number: u64, stream: &TcpStream) {
        if let Ok(stream) = stream.try_clone() {
            self.silent().push_back((number, stream));
        }
    }

    /// A connection has sent its request, or is closed.
    pub(crate) fn has_spoken(&self, number: u64) {
        self.silent().retain(|(of, _)| *of != number);
    }

    /// Ends the connection that has been silent for longest; whether there was one.
    pub(crate) fn end_silent(&self) -> bool {
        let oldest = self.silent().pop_front();
        oldest.is_some_and(|(_, stream)| stream.shutdown(Shutdown::Both).is_ok())
    }

    fn silent(&self) -> MutexGuard<'_, VecDeque<(u64, TcpStream)>> {
        self.silent.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The first call of each server thread.
    pub(crate) fn enter_thread(&self) {
        if let Some(on_thread) = &self.on_thread {
            on_thread();
        }
    }
}
