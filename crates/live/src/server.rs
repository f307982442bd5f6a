//! The server: accepts, checks, answers.

use crate::access::{Role, Secrets, is_our_host, is_our_origin};
use crate::client;
use crate::command::OperatorRequest;
use crate::feed::FeedHub;
use crate::film::Film;
use crate::http::{self, RequestError};
use crate::hub::{Clients, Hub};
use crate::page;
use crate::queue::Queue;
use crate::shared::Shared;
use std::fmt;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// Most connections at a time.
pub const MOST_CLIENTS: usize = 32;
/// Places that viewers leave free: an operator always finds one to freeze and park from.
const FOR_OPERATORS: usize = 8;
/// Interval between two sends of the hub.
const ROUND_EVERY: Duration = Duration::from_millis(40);
/// Interval between two checks for new connections.
const ACCEPT_EVERY: Duration = Duration::from_millis(20);
/// Stack of a client's thread, bytes.
const STACK: usize = 256 * 1024;

/// Where the server listens.
#[derive(Clone)]
pub struct ServerConfig {
    /// Address and port; port 0: any that is free.
    pub address: SocketAddr,
    /// Whether the user explicitly requested an address beyond this machine's own (loopback).
    pub beyond_this_machine: bool,
    /// Each thread of the server calls it first, to choose its processors.
    pub on_thread: Option<Arc<dyn Fn() + Send + Sync>>,
    /// Gives a clip by its name, as the page plays it ([`Film`]); called on a client's thread.
    pub film: Option<Film>,
}

impl fmt::Debug for ServerConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServerConfig")
            .field("address", &self.address)
            .field("beyond_this_machine", &self.beyond_this_machine)
            .finish_non_exhaustive()
    }
}

impl Default for ServerConfig {
    /// Loopback, any free port.
    fn default() -> Self {
        Self {
            address: SocketAddr::from(([127, 0, 0, 1], 0)),
            beyond_this_machine: false,
            on_thread: None,
            film: None,
        }
    }
}

/// The reason why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// Other machines can reach the address, but its own option does not permit that.
    #[error(
        "{0} can be reached from other machines: whoever has the link can move the PZT, and nothing is encrypted. Use an SSH tunnel to 127.0.0.1, or ask for it with --view-unsafe-address"
    )]
    Reachable(SocketAddr),
    /// The address cannot be listened on.
    #[error("no page at {address}: {}", held(*.address))]
    Listen {
        /// Address asked for.
        address: SocketAddr,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// No random numbers, or no thread.
    #[error("the page cannot be served")]
    System(#[from] std::io::Error),
}

/// The program that holds the address, as the end of a sentence.
fn held(address: SocketAddr) -> &'static str {
    let heard = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let host = address.to_string();
        stream.write_all(
            format!("GET /wire.js HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")
                .as_bytes(),
        )?;
        let mut text = String::new();
        stream.take(4096).read_to_string(&mut text)?;
        Ok(text)
    };
    match heard() {
        Ok(text) if text.contains(ITS_FIRST_LINE) => {
            "another cellpos serves the page of its run there; end that run, or take another port (0: any that is free)"
        }
        Ok(_) => "another program listens there",
        Err(_) => "is another program listening there, and is the address one of this machine's?",
    }
}

/// Time for the program at the address to identify itself.
const PATIENCE: Duration = Duration::from_millis(300);
/// Identity of a run's page on its line to the program.
const ITS_FIRST_LINE: &str = "The line to the program: messages in, requests out";

/// A served page; dropping it ends its threads.
pub struct Server {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Server({})", self.shared.address)
    }
}

impl Server {
    /// Listens and serves. `command` is called on a client's thread for each request of the operator: it must not wait.
    ///
    /// # Errors
    /// The address cannot be used, or other machines could reach it although the user did not request that.
    pub fn start(
        config: &ServerConfig,
        feed: FeedHub,
        command: impl Fn(OperatorRequest) + Send + Sync + 'static,
    ) -> Result<Self, LiveError> {
        if !config.address.ip().is_loopback() && !config.beyond_this_machine {
            return Err(LiveError::Reachable(config.address));
        }
        let listen = |source| LiveError::Listen {
            address: config.address,
            source,
        };
        let listener = TcpListener::bind(config.address).map_err(listen)?;
        listener.set_nonblocking(true).map_err(listen)?;
        let shared = Arc::new(Shared {
            secrets: Secrets::random()?,
            address: listener.local_addr().map_err(listen)?,
            hello: feed.hello.clone(),
            ending: AtomicBool::new(false),
            over: AtomicBool::new(false),
            clients: Clients::default(),
            connections: AtomicUsize::new(0),
            silent: Mutex::default(),
            command: Box::new(command),
            on_thread: config.on_thread.clone(),
            film: config.film.clone(),
        });
        // From here on a failure drops the server, which ends what has started.
        let mut server = Self {
            shared: Arc::clone(&shared),
            threads: vec![],
        };
        let hub = Hub::new(feed, shared.clients.clone());
        server.spawn("live-hub", move |shared| serve_hub(hub, shared))?;
        server.spawn("live-accept", move |shared| accept(&listener, shared))?;
        Ok(server)
    }

    fn spawn(
        &mut self,
        name: &str,
        work: impl FnOnce(&Arc<Shared>) + Send + 'static,
    ) -> Result<(), LiveError> {
        let shared = Arc::clone(&self.shared);
        let thread = thread::Builder::new()
            .name(name.to_string())
            .spawn(move || {
                shared.enter_thread();
                work(&shared);
            })?;
        self.threads.push(thread);
        Ok(())
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.shared.address
    }

    /// The operator's link.
    pub fn operator_url(&self) -> String {
        self.url(Role::Operator)
    }

    /// The viewer's link.
    pub fn viewer_url(&self) -> String {
        self.url(Role::Viewer)
    }

    fn url(&self, role: Role) -> String {
        let word = self.shared.secrets.word(role);
        format!("http://{}/?word={word}", self.shared.address)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // Stop the hub first, so that the clients' queues hold the end of the run before the clients are closed.
        for end in [&self.shared.ending, &self.shared.over] {
            end.store(true, Ordering::Release);
            if !self.threads.is_empty() {
                // A thread that panicked has no result.
                let _ = self.threads.remove(0).join();
            }
        }
    }
}

fn serve_hub(mut hub: Hub, shared: &Shared) {
    while !shared.ending.load(Ordering::Acquire) {
        hub.round();
        thread::sleep(ROUND_EVERY);
    }
    // The last messages, for clients that still read.
    hub.round();
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut clients: Vec<JoinHandle<()>> = vec![];
    let mut number = 0;
    while !shared.is_over() {
        clients.retain(|client| !client.is_finished());
        match listener.accept() {
            Ok((stream, _)) => {
                number += 1;
                clients.extend(greet(stream, number, shared));
            }
            Err(_) => thread::sleep(ACCEPT_EVERY),
        }
    }
    for client in clients {
        let _ = client.join();
    }
}

/// Gives a connection a thread, or refuses it. If necessary it replaces a connection that has sent nothing yet.
fn greet(mut stream: TcpStream, number: u64, shared: &Arc<Shared>) -> Option<JoinHandle<()>> {
    // The listener does not wait; its connections do.
    stream.set_nonblocking(false).ok()?;
    let full = shared.connections.fetch_add(1, Ordering::AcqRel) >= MOST_CLIENTS;
    if full && !shared.end_silent() {
        shared.connections.fetch_sub(1, Ordering::AcqRel);
        let _ = stream.set_write_timeout(Some(Duration::from_millis(100)));
        http::say(
            &mut stream,
            "503 Service Unavailable",
            "too many pages are open",
        );
        return None;
    }
    shared.await_word(number, &stream);
    let held = Arc::clone(shared);
    let thread = thread::Builder::new()
        .name("live-client".to_string())
        .stack_size(STACK)
        .spawn(move || {
            held.enter_thread();
            converse(stream, number, &held);
            held.has_spoken(number);
            held.connections.fetch_sub(1, Ordering::AcqRel);
        });
    if thread.is_err() {
        shared.has_spoken(number);
        shared.connections.fetch_sub(1, Ordering::AcqRel);
    }
    thread.ok()
}

/// One connection: a file, a request, or the live line.
fn converse(mut stream: TcpStream, number: u64, shared: &Shared) {
    let request = http::read_request(&mut stream);
    shared.has_spoken(number);
    let request = match request {
        Ok(request) => request,
        Err(RequestError::Gone) => return,
        Err(RequestError::Bad) => {
            return http::say(&mut stream, "400 Bad Request", "not a request");
        }
    };
    if !is_our_host(&request.host, shared.address) {
        let text = "this is not the host that you asked for";
        return http::say(&mut stream, "421 Misdirected Request", text);
    }
    let foreign = |origin: &String| !is_our_origin(origin, &request.host);
    if request.origin.as_ref().is_some_and(foreign) {
        return http::say(&mut stream, "403 Forbidden", "asked for by a foreign page");
    }
    if let ("GET", Some((kind, text))) = (request.method.as_str(), page::asset(&request.path)) {
        return http::answer(&mut stream, "200 OK", kind, text.as_bytes());
    }
    let Some(role) = shared.secrets.role(&request.word) else {
        let text = "open the link that cellpos printed: it carries a word that this one lacks";
        return http::say(&mut stream, "403 Forbidden", text);
    };
    match (
        request.method.as_str(),
        request.path.as_str(),
        &request.websocket_key,
    ) {
        ("GET", "/", None) => {
            http::answer(
                &mut stream,
                "200 OK",
                "text/html; charset=utf-8",
                page::INDEX.as_bytes(),
            );
        }
        ("GET", "/clip", None) => match shared.film.as_ref().and_then(|film| film(&request.name)) {
            Some(film) => {
                http::answer(&mut stream, "200 OK", "application/octet-stream", &film);
            }
            None => http::say(&mut stream, "404 Not Found", "there is no such clip"),
        },
        // A browser always states the origin of a script: a request without one is not from this page.
        ("GET", "/live", Some(_)) if request.origin.is_none() => {
            http::say(&mut stream, "403 Forbidden", "no origin");
        }
        ("GET", "/live", Some(_))
            if role == Role::Viewer && shared.clients.count() >= MOST_CLIENTS - FOR_OPERATORS =>
        {
            http::say(
                &mut stream,
                "503 Service Unavailable",
                "too many pages are open",
            );
        }
        ("GET", "/live", Some(key)) => {
            if http::switch_to_websocket(&mut stream, key).is_ok() {
                let queue = Arc::new(Queue::default());
                shared.clients.add(Arc::clone(&queue));
                client::serve(stream, role, &queue, shared);
            }
        }
        ("POST", "/do", None) => match client::act(&request.body, role, shared) {
            Ok(()) => http::say(&mut stream, "200 OK", "done"),
            Err(error) => http::say(&mut stream, "400 Bad Request", &error.to_string()),
        },
        _ => http::say(&mut stream, "404 Not Found", "there is no such page"),
    }
}
