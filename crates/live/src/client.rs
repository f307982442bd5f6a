//! One client: its queue, and the thread that empties it into a socket and reads what the client asks.

use crate::access::Role;
use crate::command::{Command, CommandError};
use crate::server::Shared;
use std::collections::VecDeque;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tungstenite::protocol::{Role as Side, WebSocketConfig};
use tungstenite::{Error, Message, WebSocket};

/// Messages that wait for a client: about two seconds of them.
const MESSAGES: usize = 100;
/// How often a client is looked after when nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// A client that takes nothing for this long is let go.
const STALLED_AFTER: Duration = Duration::from_secs(5);
/// Requests of a second; a client that asks more is let go.
const MOST_REQUESTS: u32 = 50;
/// Longest message of a client, bytes.
const MESSAGE_BYTES: usize = 4096;

/// What waits for a client. When it is full the oldest message goes and is counted.
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

    /// The oldest that waits, or none after `most`.
    fn next(&self, most: Duration) -> Option<Message> {
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

    /// Says that the client is gone.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Whether the client is gone.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Whether this is the first time it is asked.
    pub(crate) fn is_new(&self) -> bool {
        !self.told.swap(true, Ordering::AcqRel)
    }
}

/// Serves a client until it goes, stalls, floods, or the server ends.
pub(crate) fn serve(stream: TcpStream, role: Role, queue: &Queue, shared: &Shared) {
    let _ = stream.set_nodelay(true);
    if stream.set_nonblocking(true).is_ok() {
        let config = WebSocketConfig::default()
            .max_message_size(Some(MESSAGE_BYTES))
            .max_frame_size(Some(MESSAGE_BYTES))
            .write_buffer_size(0)
            .max_write_buffer_size(16 << 20);
        let mut client = Client {
            socket: WebSocket::from_raw_socket(stream, Side::Server, Some(config)),
            role,
            second: Instant::now(),
            requests: 0,
        };
        let _ = client.run(queue, shared);
    }
    queue.close();
}

struct Client {
    socket: WebSocket<TcpStream>,
    role: Role,
    second: Instant,
    requests: u32,
}

impl Client {
    fn run(&mut self, queue: &Queue, shared: &Shared) -> Result<(), Error> {
        let mut pending = !done(self.socket.send(shared.hello(self.role)))?;
        let mut progress = Instant::now();
        let mut told_lost = 0;
        while !shared.is_over() {
            let lost = queue.lost();
            if !pending && lost != told_lost {
                told_lost = lost;
                let unshown = serde_json::json!({ "unshown": lost });
                pending = !done(self.socket.send(Message::text(unshown.to_string())))?;
            }
            if !pending && let Some(message) = queue.next(LOOK_EVERY) {
                pending = !done(self.socket.send(message))?;
                progress = Instant::now();
            } else if pending {
                std::thread::sleep(LOOK_EVERY);
                pending = !done(self.socket.flush())?;
                if progress.elapsed() > STALLED_AFTER {
                    return Err(Error::ConnectionClosed);
                }
            }
            self.requests(shared)?;
        }
        while !pending && let Some(message) = queue.next(Duration::ZERO) {
            pending = !done(self.socket.send(message))?;
        }
        let _ = self.socket.close(None);
        let _ = self.socket.flush();
        Ok(())
    }

    /// Reads and acts on what the client has asked.
    fn requests(&mut self, shared: &Shared) -> Result<(), Error> {
        if self.second.elapsed() > Duration::from_secs(1) {
            self.second = Instant::now();
            self.requests = 0;
        }
        loop {
            let message = match self.socket.read() {
                Ok(message) => message,
                Err(error) => return done(Err(error)).map(|_| ()),
            };
            self.requests += 1;
            if self.requests > MOST_REQUESTS {
                return Err(Error::ConnectionClosed);
            }
            if let Message::Text(text) = message {
                let answer = match act(&text, self.role, shared) {
                    Ok(()) => serde_json::json!({ "done": true }),
                    Err(error) => serde_json::json!({ "refused": error.to_string() }),
                };
                done(self.socket.send(Message::text(answer.to_string())))?;
            }
        }
    }
}

/// Carries out a request.
pub(crate) fn act(text: &str, role: Role, shared: &Shared) -> Result<(), CommandError> {
    if role != Role::Operator {
        return Err(CommandError::ViewerOnly);
    }
    shared.ask(Command::read(text, shared.view_um())?);
    Ok(())
}

/// Whether it is done; not yet, when the socket would have to wait.
fn done(result: Result<(), Error>) -> Result<bool, Error> {
    match result {
        Ok(()) => Ok(true),
        Err(Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => Ok(false),
        Err(error) => Err(error),
    }
}
