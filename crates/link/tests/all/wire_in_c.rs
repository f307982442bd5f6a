//! The C99 file of the wire as a program that is asked byte string by byte string.

use crate::vectors::root;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command as Program, Stdio};

/// The C99 decoder and encoder, compiled.
pub(crate) struct InC {
    folder: PathBuf,
}

impl InC {
    pub(crate) fn compile(name: &str) -> Self {
        let folder =
            std::env::temp_dir().join(format!("cellpos-wire-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder for the program");
        let status = Program::new("cc")
            .args([
                "-std=c99",
                "-Wall",
                "-Wextra",
                "-Wpedantic",
                "-Werror",
                "-O2",
                "-o",
            ])
            .arg(folder.join("compare"))
            .arg(root().join("firmware/c/compare.c"))
            .status()
            .expect("a C compiler called cc (Debian: gcc)");
        assert!(status.success(), "firmware/c does not compile");
        Self { folder }
    }

    /// What it finds in each byte string.
    pub(crate) fn found(&self, strings: &[(u8, Vec<u8>)]) -> Vec<String> {
        let mut child = Program::new(self.folder.join("compare"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("it was compiled");
        let mut stdin = child.stdin.take().expect("piped");
        let mut input = Vec::new();
        for (direction, bytes) in strings {
            input.extend(u16::try_from(bytes.len()).expect("short").to_le_bytes());
            input.push(*direction);
            input.extend(bytes);
        }
        let writer = std::thread::spawn(move || stdin.write_all(&input));
        let output = child.wait_with_output().expect("it ends");
        writer.join().expect("no panic").expect("it reads all");
        assert!(output.status.success());
        let text = String::from_utf8(output.stdout).expect("text");
        text.lines().map(str::to_owned).collect()
    }
}

impl Drop for InC {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}
