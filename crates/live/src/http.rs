//! The part of HTTP that one page needs: a bounded request, a few fixed answers.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Longest head of a request, bytes.
const HEAD_BYTES: usize = 8192;
/// Longest body of a request, bytes.
const BODY_BYTES: usize = 4096;
/// Time within which a request must be complete.
const REQUEST_WITHIN: Duration = Duration::from_secs(3);

/// Headers of every answer: no page may frame this one, and no content may come from elsewhere.
const SAFE_HEADERS: &str = "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; \
img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n\
X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nReferrer-Policy: no-referrer\r\n\
Cross-Origin-Resource-Policy: same-origin\r\nCache-Control: no-store\r\nConnection: close\r\n";

/// A request.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Request {
    pub method: String,
    pub path: String,
    /// The word in the link.
    pub word: String,
    /// The name of the requested item, if the path alone does not give it.
    pub name: String,
    pub host: String,
    pub origin: Option<String>,
    /// The client's key, if it requests a WebSocket.
    pub websocket_key: Option<String>,
    pub body: String,
}

/// The reason why there is no request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RequestError {
    /// Closed, timed out or broken: an answer is impossible.
    Gone,
    /// Too long, or not HTTP.
    Bad,
}

/// Reads one request.
pub(crate) fn read_request(stream: &mut TcpStream) -> Result<Request, RequestError> {
    let deadline = Instant::now() + REQUEST_WITHIN;
    let mut bytes = Vec::new();
    let (mut request, head, body_length) = loop {
        if let Some(parsed) = parse_head(&bytes)? {
            break parsed;
        }
        if bytes.len() >= HEAD_BYTES {
            return Err(RequestError::Bad);
        }
        read_more(stream, &mut bytes, deadline)?;
    };
    if body_length > BODY_BYTES {
        return Err(RequestError::Bad);
    }
    while bytes.len() < head + body_length {
        read_more(stream, &mut bytes, deadline)?;
    }
    request.body = String::from_utf8(bytes[head..head + body_length].to_vec())
        .map_err(|_| RequestError::Bad)?;
    Ok(request)
}

fn read_more(
    stream: &mut TcpStream,
    bytes: &mut Vec<u8>,
    deadline: Instant,
) -> Result<(), RequestError> {
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() {
        return Err(RequestError::Gone);
    }
    stream
        .set_read_timeout(Some(left))
        .map_err(|_| RequestError::Gone)?;
    let mut chunk = [0; 2048];
    match stream.read(&mut chunk) {
        Ok(0) | Err(_) => Err(RequestError::Gone),
        Ok(read) => {
            bytes.extend(&chunk[..read]);
            Ok(())
        }
    }
}

/// The request, the length of its head and that of its body; `None`: more has to be read.
fn parse_head(bytes: &[u8]) -> Result<Option<(Request, usize, usize)>, RequestError> {
    let mut headers = [httparse::EMPTY_HEADER; 64];
    let mut parsed = httparse::Request::new(&mut headers);
    let head = match parsed.parse(bytes) {
        Ok(httparse::Status::Complete(head)) => head,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(_) => return Err(RequestError::Bad),
    };
    let mut request = Request {
        method: parsed.method.unwrap_or_default().to_string(),
        ..Request::default()
    };
    let target = parsed.path.unwrap_or_default();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    request.path = path.to_string();
    let of_query = |key: &str| {
        let value = query.split('&').find_map(|pair| pair.strip_prefix(key));
        value.unwrap_or_default().to_string()
    };
    (request.word, request.name) = (of_query("word="), of_query("name="));
    let mut upgrade = false;
    let mut key = None;
    let mut body_length = 0;
    for header in parsed.headers.iter() {
        let value = std::str::from_utf8(header.value).map_err(|_| RequestError::Bad)?;
        match header.name.to_ascii_lowercase().as_str() {
            "host" => request.host = value.to_string(),
            "origin" => request.origin = Some(value.to_string()),
            "upgrade" => upgrade = value.eq_ignore_ascii_case("websocket"),
            "sec-websocket-key" => key = Some(value.to_string()),
            "content-length" => body_length = value.parse().map_err(|_| RequestError::Bad)?,
            "transfer-encoding" => return Err(RequestError::Bad),
            _ => {}
        }
    }
    request.websocket_key = key.filter(|_| upgrade);
    Ok(Some((request, head, body_length)))
}

/// Answers and closes.
pub(crate) fn answer(stream: &mut TcpStream, status: &str, kind: &str, body: &[u8]) {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\n{SAFE_HEADERS}\r\n",
        body.len()
    );
    let _ = stream.set_write_timeout(Some(Duration::from_secs(5)));
    if stream.write_all(head.as_bytes()).is_ok() {
        let _ = stream.write_all(body);
    }
    let _ = stream.shutdown(std::net::Shutdown::Write);
}

/// Answers with a line of text.
pub(crate) fn say(stream: &mut TcpStream, status: &str, text: &str) {
    answer(stream, status, "text/plain; charset=utf-8", text.as_bytes());
}

/// Takes up a WebSocket.
pub(crate) fn switch_to_websocket(stream: &mut TcpStream, key: &str) -> std::io::Result<()> {
    let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
    );
    stream.write_all(head.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_head_is_read_whole_or_asked_for_again() {
        let text = b"GET /live?word=ab&x=1 HTTP/1.1\r\nHost: localhost:1\r\nOrigin: http://localhost:1\r\n\
            Upgrade: WebSocket\r\nSec-WebSocket-Key: k\r\n\r\n";
        for end in 0..text.len() {
            assert_eq!(parse_head(&text[..end]), Ok(None), "{end}");
        }
        let (request, head, body) = parse_head(text).unwrap().unwrap();
        assert_eq!((head, body), (text.len(), 0));
        assert_eq!(request.path, "/live");
        assert_eq!(request.word, "ab");
        assert_eq!(request.websocket_key.as_deref(), Some("k"));
        assert_eq!(request.origin.as_deref(), Some("http://localhost:1"));
    }

    #[test]
    fn what_is_not_http_is_refused() {
        assert_eq!(parse_head(b"\x00\x01\x02\r\n\r\n"), Err(RequestError::Bad));
        let chunked = b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n";
        assert_eq!(parse_head(chunked), Err(RequestError::Bad));
        let long = b"POST / HTTP/1.1\r\nContent-Length: many\r\n\r\n";
        assert_eq!(parse_head(long), Err(RequestError::Bad));
    }
}
