//! One client: its queue, and the thread that empties it into a socket and reads requests.

use crate::access::Role;
use crate::command::{CommandError, OperatorRequest};
use crate::queue::Queue;
use crate::shared::Shared;
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tungstenite::protocol::{Role as Side, WebSocketConfig};
use tungstenite::{Error, Message, WebSocket};

/// Interval of service for a client when nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// A client that takes nothing for this long is disconnected.
const STALLED_AFTER: Duration = Duration::from_secs(5);
/// Requests per second; a client with more is disconnected.
const MOST_REQUESTS: u32 = 50;
/// Longest message of a client, bytes.
const MESSAGE_BYTES: usize = 4096;

/// Serves a client until it disconnects, stalls or floods, or the server ends.
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

    /// Reads and executes the client's requests.
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
    shared.ask(OperatorRequest::read(text, shared.targets_um())?);
    Ok(())
}

/// Whether the operation is done; not yet if the socket would block.
fn done(result: Result<(), Error>) -> Result<bool, Error> {
    match result {
        Ok(()) => Ok(true),
        Err(Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => Ok(false),
        Err(error) => Err(error),
    }
}
