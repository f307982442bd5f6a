//! A real browser, driven by the WebDriver protocol: Debian's `chromium` and `chromium-driver`.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A headless Chromium with one page.
pub struct Browser {
    driver: Child,
    port: u16,
    session: String,
}

impl Browser {
    /// Starts driver and browser with a window of this size, px.
    ///
    /// # Panics
    /// Without `chromedriver`, with what to install.
    pub fn start(width: u32, height: u32) -> Self {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()
            .expect("chromedriver: apt-get install chromium chromium-driver");
        let mut lines = BufReader::new(driver.stdout.take().expect("piped")).lines();
        let port = lines
            .find_map(|line| {
                let line = line.ok()?;
                // Its first line repeats the 0 that it was given.
                let (_, rest) = line.split_once("successfully on port ")?;
                rest.trim_end_matches('.').parse().ok()
            })
            .expect("chromedriver says its port");
        // Further output must not fill the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        let mut browser = Self {
            driver,
            port,
            session: String::new(),
        };
        let switches = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--disable-quic",
            "--hide-scrollbars",
            "--enable-precise-memory-info",
            &format!("--window-size={width},{height}"),
        ];
        let wanted = json!({ "capabilities": { "alwaysMatch": {
            "goog:chromeOptions": { "args": switches },
            "goog:loggingPrefs": { "browser": "ALL" },
        } } });
        let answer = browser.ask("POST", "/session", &wanted);
        browser.session = text(&answer["sessionId"]);
        browser
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> Value {
        let body = if method == "POST" {
            body.to_string()
        } else {
            String::new()
        };
        let mut stream =
            TcpStream::connect(("127.0.0.1", self.port)).expect("chromedriver listens");
        stream
            .set_read_timeout(Some(Duration::from_secs(60)))
            .expect("a time limit");
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            self.port,
            body.len()
        )
        .expect("chromedriver reads");
        let answer = read_answer(BufReader::new(stream)).expect("chromedriver answers");
        let value: Value =
            serde_json::from_str(&answer).unwrap_or_else(|e| panic!("{e}: {answer}"));
        assert!(
            value["value"]["error"].is_null(),
            "{path}: {}",
            value["value"]
        );
        value["value"].clone()
    }

    fn on_session(&self, method: &str, path: &str, body: &Value) -> Value {
        self.ask(method, &format!("/session/{}{path}", self.session), body)
    }

    /// Opens an address.
    pub fn open(&self, url: &str) {
        self.on_session("POST", "/url", &json!({ "url": url }));
    }

    /// Shows the page as on a screen of this size, px; a window has a least width.
    pub fn resize(&self, width: u32, height: u32) {
        let size = json!({
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600,
        });
        let body = json!({ "cmd": "Emulation.setDeviceMetricsOverride", "params": size });
        self.on_session("POST", "/goog/cdp/execute", &body);
    }

    /// What a script returns.
    pub fn run(&self, script: &str) -> Value {
        let body = json!({ "script": script, "args": [] });
        self.on_session("POST", "/execute/sync", &body)
    }

    /// Text of an element, as it is shown.
    pub fn text_of(&self, id: &str) -> String {
        text(&self.run(&format!(
            "return document.getElementById('{id}').textContent"
        )))
    }

    /// Clicks a button and waits until the page is in one of some states; says how long that took by the page's own clock, ms.
    ///
    /// # Panics
    /// After three seconds.
    pub fn click_until(&self, id: &str, states: &[&str]) -> f64 {
        self.run(&format!(
            "const start = performance.now(), wanted = {};
             window.took = null;
             new MutationObserver(() => {{
               if (wanted.includes(document.body.dataset.state)) window.took ??= performance.now() - start;
             }}).observe(document.body, {{ attributes: true }});
             document.getElementById('{id}').click();",
            json!(states)
        ));
        self.wait_for("return window.took !== null", Duration::from_secs(3));
        self.run("return window.took").as_f64().expect("a time")
    }

    /// Clicks an element as a person does: it has to be seen.
    pub fn click(&self, id: &str) {
        let query = json!({ "using": "css selector", "value": format!("#{id}") });
        let found = self.on_session("POST", "/element", &query);
        let element = text(
            found
                .as_object()
                .and_then(|o| o.values().next())
                .expect("an element"),
        );
        self.on_session("POST", &format!("/element/{element}/click"), &json!({}));
    }

    /// Waits until a script returns true; how long it took.
    ///
    /// # Panics
    /// When it does not within `most`.
    pub fn wait_for(&self, script: &str, most: Duration) -> Duration {
        let start = Instant::now();
        loop {
            if self.run(script) == Value::Bool(true) {
                return start.elapsed();
            }
            assert!(
                start.elapsed() < most,
                "not within {most:?}: {script}\npage: {}",
                self.run("return document.body.innerText")
            );
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Console messages of the page since the last call, loading errors included.
    pub fn console(&self) -> Vec<String> {
        let log = self.on_session("POST", "/se/log", &json!({ "type": "browser" }));
        let lines = log.as_array().cloned().unwrap_or_default();
        lines.iter().map(|line| text(&line["message"])).collect()
    }

    /// Memory of driver and browser together, kB: RAM of their processes, shared pages counted once per process.
    pub fn memory_kb(&self) -> u64 {
        let group = self.driver.id();
        let Ok(processes) = std::fs::read_dir("/proc") else {
            return 0;
        };
        processes
            .flatten()
            .filter_map(|entry| {
                let stat = std::fs::read_to_string(entry.path().join("stat")).ok()?;
                // Behind the name, which may hold anything: state, parent, group.
                let (_, rest) = stat.rsplit_once(')')?;
                let of: u32 = rest.split_whitespace().nth(2)?.parse().ok()?;
                (of == group).then(|| resident_kb(&entry.path()))
            })
            .sum()
    }

    /// What the page's own objects take, bytes, collected first.
    pub fn heap_bytes(&self) -> f64 {
        let body = json!({ "cmd": "HeapProfiler.collectGarbage", "params": {} });
        self.on_session("POST", "/goog/cdp/execute", &body);
        let used = self.run("return performance.memory.usedJSHeapSize");
        used.as_f64().unwrap_or(f64::NAN)
    }

    /// Keeps a picture of the page.
    ///
    /// # Panics
    /// Where it cannot be written.
    pub fn screenshot(&self, path: &Path) {
        let taken = self.on_session("GET", "/screenshot", &Value::Null);
        std::fs::write(path, base64(&text(&taken))).expect("a screenshot is written");
    }
}

/// RAM of a process, kB; 0 if it is gone. `process`: its folder in /proc.
pub fn resident_kb(process: &Path) -> u64 {
    let status = std::fs::read_to_string(process.join("status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kb = line.and_then(|rest| rest.split_whitespace().next()?.parse().ok());
    kb.unwrap_or(0)
}

/// The body of an answer; the driver leaves the line open behind it.
fn read_answer(mut from: impl BufRead) -> std::io::Result<String> {
    let (mut line, mut length) = (String::new(), 0);
    while from.read_line(&mut line)? > 2 {
        if let Some((name, value)) = line.split_once(':')
            && name.eq_ignore_ascii_case("content-length")
        {
            length = value.trim().parse().map_err(std::io::Error::other)?;
        }
        line.clear();
    }
    let mut body = vec![0; length];
    from.read_exact(&mut body)?;
    String::from_utf8(body).map_err(std::io::Error::other)
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Closing the session ends the browser in good order. If that fails, or the test did, driver and browser are one group of
        // processes: none outlives the test.
        if !self.session.is_empty() && !std::thread::panicking() {
            self.on_session("DELETE", "", &Value::Null);
        }
        let group = rustix::process::Pid::from_child(&self.driver);
        let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
        let _ = self.driver.wait();
    }
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_string()
}

fn base64(text: &str) -> Vec<u8> {
    let value = |c: u8| match c {
        b'A'..=b'Z' => Some(c - b'A'),
        b'a'..=b'z' => Some(c - b'a' + 26),
        b'0'..=b'9' => Some(c - b'0' + 52),
        b'+' => Some(62),
        b'/' => Some(63),
        _ => None,
    };
    let mut bytes = vec![];
    let mut held = 0_u32;
    let mut bits = 0;
    for digit in text.bytes().filter_map(value) {
        held = held << 6 | u32::from(digit);
        bits += 6;
        if bits >= 8 {
            bits -= 8;
            bytes.push((held >> bits) as u8);
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    #[test]
    fn base_64_is_read() {
        assert_eq!(super::base64("aGVsbG8="), b"hello");
        assert_eq!(super::base64("aGVsbA=="), b"hell");
    }
}
