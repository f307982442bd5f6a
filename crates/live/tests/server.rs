//! The server as clients meet it: a browser that behaves, one that does not, a page from elsewhere.

use cellpos_live::{
    EventLine, Feed, Hello, OperatorRequest, Picture, Row, Server, ServerConfig, State,
};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tungstenite::Message;
use tungstenite::client::IntoClientRequest;

struct Page {
    feed: Feed,
    server: Server,
    asked: Arc<Mutex<Vec<OperatorRequest>>>,
}

fn page() -> Page {
    let (feed, hub) = Feed::new(Hello {
        name: "<script>alert(1)</script>".into(),
        view_um: [-12.8, 12.8],
        pictures: true,
        ..Hello::default()
    });
    let asked = Arc::new(Mutex::new(vec![]));
    let told = Arc::clone(&asked);
    let server = Server::start(&ServerConfig::default(), hub, move |command| {
        told.lock().unwrap().push(command);
    })
    .unwrap();
    Page {
        feed,
        server,
        asked,
    }
}

fn word(url: &str) -> &str {
    url.split_once("word=").unwrap().1
}

impl Page {
    fn raw(&self, request: &str) -> String {
        let mut stream = TcpStream::connect(self.server.address()).unwrap();
        stream
            .set_read_timeout(Some(Duration::from_secs(10)))
            .unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        let _ = stream.read_to_string(&mut answer);
        answer
    }

    fn get(&self, path: &str) -> String {
        let host = self.server.address();
        self.raw(&format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n"))
    }

    fn socket(&self, url: &str, origin: &str) -> Result<Socket, tungstenite::Error> {
        let address = self.server.address();
        let mut request =
            format!("ws://{address}/live?word={}", word(url)).into_client_request()?;
        let value = origin.parse().expect("an origin");
        request.headers_mut().insert("Origin", value);
        let stream = TcpStream::connect(address)?;
        stream.set_read_timeout(Some(Duration::from_secs(10)))?;
        match tungstenite::client(request, stream) {
            Ok((socket, _)) => Ok(socket),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(error),
            Err(error) => panic!("{error}"),
        }
    }

    fn operator(&self) -> Socket {
        let origin = format!("http://{}", self.server.address());
        self.socket(&self.server.operator_url(), &origin).unwrap()
    }
}

type Socket = tungstenite::WebSocket<TcpStream>;

/// Reads until `found` says so.
fn until<T>(socket: &mut Socket, mut found: impl FnMut(&Message) -> Option<T>) -> T {
    loop {
        if let Some(it) = found(&socket.read().unwrap()) {
            return it;
        }
    }
}

fn text_with<'a>(part: &'a str) -> impl FnMut(&Message) -> Option<String> + 'a {
    move |message| match message {
        Message::Text(text) if text.contains(part) => Some(text.to_string()),
        _ => None,
    }
}

fn wait_for(mut what: impl FnMut() -> bool) {
    let start = Instant::now();
    while !what() {
        assert!(
            start.elapsed() < Duration::from_secs(10),
            "it did not happen"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn the_page_comes_with_the_word_and_only_with_it_and_nothing_may_frame_it() {
    let page = page();
    for url in [page.server.operator_url(), page.server.viewer_url()] {
        let answer = page.get(&format!("/?word={}", word(&url)));
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        assert!(answer.contains("frame-ancestors 'none'"), "{answer}");
        assert!(answer.contains("default-src 'none'"), "{answer}");
        // The name comes as data and is shown as text; it is not in the page.
        assert!(!answer.contains("alert(1)"));
    }
    for path in ["/", "/?word=", "/?word=0123", "/live"] {
        assert!(page.get(path).starts_with("HTTP/1.1 403"), "{path}");
    }
    assert!(page.get("/page.js").starts_with("HTTP/1.1 200"));
    assert!(page.get("/../Cargo.toml").starts_with("HTTP/1.1 403"));
}

#[test]
fn a_foreign_host_or_origin_is_refused_with_the_right_word() {
    let page = page();
    let url = page.server.operator_url();
    let word = word(&url);
    let rebound = format!("GET /?word={word} HTTP/1.1\r\nHost: evil.example\r\n\r\n");
    assert!(page.raw(&rebound).starts_with("HTTP/1.1 421"));
    let host = page.server.address();
    let post = |origin: &str| {
        page.raw(&format!(
            "POST /do?word={word} HTTP/1.1\r\nHost: {host}\r\n{origin}Content-Length: 13\r\n\r\n{{\"do\":\"park\"}}"
        ))
    };
    assert!(post("Origin: http://evil.example\r\n").starts_with("HTTP/1.1 403"));
    assert!(page.asked.lock().unwrap().is_empty());
    assert!(page.socket(&url, "http://evil.example").is_err());
    assert!(post(&format!("Origin: http://{host}\r\n")).starts_with("HTTP/1.1 200"));
    assert_eq!(*page.asked.lock().unwrap(), [OperatorRequest::Park]);
}

#[test]
fn a_client_is_told_the_run_its_rows_and_pictures_and_the_operator_is_heard() {
    let mut page = page();
    let mut socket = page.operator();
    let hello = until(&mut socket, text_with("hello"));
    assert!(hello.contains("\"operator\":true"), "{hello}");
    page.feed.row(&Row {
        seq: 41,
        time_s: 0.5,
        measured_um: 1.25,
        ..Row::default()
    });
    let row = until(&mut socket, |message| match message {
        Message::Binary(bytes) if bytes[0] == 1 => Some(bytes.to_vec()),
        _ => None,
    });
    assert_eq!(u32::from_le_bytes(row[4..8].try_into().unwrap()), 1);
    assert_eq!(f64::from_le_bytes(row[8..16].try_into().unwrap()), 0.5);
    assert_eq!(u32::from_le_bytes(row[16..20].try_into().unwrap()), 41);
    assert_eq!(f32::from_le_bytes(row[24..28].try_into().unwrap()), 1.25);
    page.feed
        .take_pictures()
        .unwrap()
        .offer(0.5, |picture: &mut Picture| {
            (picture.width, picture.height) = (2, 1);
            picture.pixels.extend([3, 4]);
        });
    let picture = until(&mut socket, |message| match message {
        Message::Binary(bytes) if bytes[0] == 2 => Some(bytes.to_vec()),
        _ => None,
    });
    assert_eq!(picture[picture.len() - 2..], [3, 4]);
    page.feed.state(State::default());
    until(&mut socket, text_with("banner"));
    page.feed.event(EventLine {
        time_s: 1.0,
        level: "info",
        text: "<img src=x onerror=alert(1)>".into(),
    });
    until(&mut socket, text_with("onerror"));
    socket
        .send(Message::text(r#"{"do":"target","um":2.5}"#))
        .unwrap();
    until(&mut socket, text_with("done"));
    assert_eq!(
        *page.asked.lock().unwrap(),
        [OperatorRequest::Target { um: 2.5 }]
    );
    socket
        .send(Message::text(r#"{"do":"target","um":99}"#))
        .unwrap();
    let refused = until(&mut socket, text_with("refused"));
    assert!(refused.contains("12.8"), "{refused}");
}

#[test]
fn a_viewer_sees_and_cannot_act() {
    let page = page();
    let origin = format!("http://{}", page.server.address());
    let mut socket = page.socket(&page.server.viewer_url(), &origin).unwrap();
    assert!(until(&mut socket, text_with("hello")).contains("\"operator\":false"));
    socket.send(Message::text(r#"{"do":"park"}"#)).unwrap();
    until(&mut socket, text_with("refused"));
    assert!(page.asked.lock().unwrap().is_empty());
}

#[test]
fn clients_that_flood_stall_or_talk_nonsense_do_not_keep_others_from_the_stop_key() {
    let mut page = page();
    let mut stalled: Vec<Socket> = (0..10).map(|_| page.operator()).collect();
    let mut flooding: Vec<Socket> = (0..5).map(|_| page.operator()).collect();
    for socket in &mut flooding {
        for _ in 0..200 {
            if socket
                .send(Message::text(r#"{"do":"note","text":"x"}"#))
                .is_err()
            {
                break;
            }
        }
    }
    for garbage in [
        "\0\x01\x02\r\n\r\n",
        "GET",
        "GET / HTTP/1.1\r\nTransfer-Encoding: x\r\n\r\n",
    ] {
        let mut stream = TcpStream::connect(page.server.address()).unwrap();
        let _ = stream.write_all(garbage.as_bytes());
    }
    // Rows of a minute, which those that stall do not read.
    for seq in 0..60_000 {
        page.feed.row(&Row {
            seq,
            ..Row::default()
        });
        if seq % 2000 == 0 {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
    let mut socket = page.operator();
    socket.send(Message::text(r#"{"do":"freeze"}"#)).unwrap();
    wait_for(|| {
        page.asked
            .lock()
            .unwrap()
            .contains(&OperatorRequest::Freeze)
    });
    let notes = page.asked.lock().unwrap().len();
    assert!(notes < 5 * 60, "{notes} requests of floods passed");
    stalled.clear();
}

#[test]
fn more_than_enough_connections_are_sent_away_and_the_rest_stays() {
    let page = page();
    let sockets: Vec<Socket> = (0..cellpos_live::MOST_CLIENTS)
        .map(|_| page.operator())
        .collect();
    assert!(page.get("/page.js").starts_with("HTTP/1.1 503"));
    drop(sockets);
    wait_for(|| page.get("/page.js").starts_with("HTTP/1.1 200"));
}

#[test]
fn silent_connections_and_viewers_do_not_keep_an_operator_from_the_stop_key() {
    let page = page();
    let address = page.server.address();
    let connect = || TcpStream::connect(address).unwrap();
    let silent: Vec<TcpStream> = (0..cellpos_live::MOST_CLIENTS).map(|_| connect()).collect();
    std::thread::sleep(Duration::from_millis(100));
    let from = Instant::now();
    let mut socket = page.operator();
    socket.send(Message::text(r#"{"do":"freeze"}"#)).unwrap();
    let asked = |request| page.asked.lock().unwrap().contains(&request);
    wait_for(|| asked(OperatorRequest::Freeze));
    // Before the first one is closed for its silence.
    assert!(from.elapsed() < Duration::from_secs(2));
    drop((silent, socket));
    let origin = format!("http://{address}");
    let viewer = page.server.viewer_url();
    let viewers: Vec<_> = (0..cellpos_live::MOST_CLIENTS)
        .map(|_| page.socket(&viewer, &origin))
        .collect();
    assert!(viewers.iter().any(Result::is_err));
    let mut socket = page.operator();
    socket.send(Message::text(r#"{"do":"park"}"#)).unwrap();
    wait_for(|| asked(OperatorRequest::Park));
}

#[test]
fn an_address_that_others_can_reach_must_be_asked_for_by_name() {
    let config = ServerConfig {
        address: "0.0.0.0:0".parse().unwrap(),
        ..ServerConfig::default()
    };
    let (_, hub) = Feed::new(Hello::default());
    let error = Server::start(&config, hub, |_| ()).unwrap_err();
    assert!(
        error.to_string().contains("--view-unsafe-address"),
        "{error}"
    );
}

#[test]
fn dropping_the_server_tells_how_it_ended_and_ends_its_threads_and_connections() {
    let mut page = page();
    let mut socket = page.operator();
    until(&mut socket, text_with("hello"));
    let address = page.server.address();
    page.feed.event(EventLine {
        time_s: 1.0,
        level: "info",
        text: "the last word".into(),
    });
    drop(page.server);
    assert!(TcpStream::connect(address).is_err());
    until(&mut socket, text_with("the last word"));
    while socket.read().is_ok() {}
}

#[test]
fn a_clip_is_given_to_whoever_may_look_and_to_nobody_else() {
    let (_feed, hub) = Feed::new(Hello::default());
    let film: cellpos_live::Film = Arc::new(|name| (name == "frozen").then(|| vec![7; 100_000]));
    let config = ServerConfig {
        film: Some(film),
        ..ServerConfig::default()
    };
    let server = Server::start(&config, hub, |_| ()).unwrap();
    let get = |path: &str| {
        let mut stream = TcpStream::connect(server.address()).unwrap();
        let host = server.address();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n").unwrap();
        let mut answer = vec![];
        stream.read_to_end(&mut answer).unwrap();
        answer
    };
    let starts = |answer: &[u8], with: &str| {
        let head = String::from_utf8_lossy(&answer[..answer.len().min(60)]).into_owned();
        assert!(head.starts_with(with), "{head}");
    };
    let word = word(&server.viewer_url()).to_string();
    let answer = get(&format!("/clip?word={word}&name=frozen"));
    starts(&answer, "HTTP/1.1 200");
    assert!(answer.ends_with(&[7; 100_000]));
    starts(
        &get(&format!("/clip?word={word}&name=none")),
        "HTTP/1.1 404",
    );
    starts(&get("/clip?name=frozen"), "HTTP/1.1 403");
}
