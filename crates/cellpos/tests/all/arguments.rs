//! Arguments that cannot be right: a sentence about them, exit code 2, and nothing measured or written.

use crate::common::{cellpos, succeed};

#[test]
fn what_cannot_be_right_gets_a_sentence_in_plain_words() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let track = "track --target 0um --duration 1s --clock virtual --frames off";
    succeed(at, &format!("{track} --name one"));
    for (line, words) in [
        ("track --target 0um --duration -3s", "above zero"),
        ("track --target 0um --seed -1", "must not be below zero"),
        ("track --target 0um --seed 1.5", "write a whole number"),
        (
            "track --target 0um --seed 99999999999999999999999",
            "too large",
        ),
        ("track --target 0um --name ../elsewhere", "letters, digits"),
        ("export latest-one --every 0", "above zero"),
        ("export latest-one --every -2", "must not be below zero"),
        ("export latest-one --out one.feather", "no such format"),
        ("export latest-one --columns seq,seq", "asked for twice"),
        ("export latest-one --columns zeit", "there is no column"),
        ("export latest-one --from 60s", "its last at"),
        ("run one.toml --cells -1", "must not be below zero"),
        ("doctor --for -1s", "--for"),
        ("bundle latest-one --out one.csv/packed", "one.csv"),
        (
            "export latest-one --out one.csv/of/it.csv",
            "one.csv is a file, not a folder",
        ),
        ("identify --data /dev/zero", "device"),
        ("reconcile --model eq6 --data /dev/zero", "device"),
        (
            "simulate --model eq6 --input /dev/zero --out s.csv",
            "device",
        ),
        ("track --target 0um --duration 1s --rig /dev/zero", "device"),
        (
            "track --target 0um --duration 1s --clock virtual --frames off --runs one.csv",
            "cannot create one.csv: it is a file, not a folder",
        ),
    ] {
        std::fs::write(at.join("one.csv"), "").unwrap();
        let ran = cellpos(at, line);
        assert_eq!(ran.code, Some(2), "{line}: {}", ran.err);
        let said = ran.err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(said.contains(words), "{line}: {said}");
        for word in ["digit found", "non-zero type", "u64", "i64", "panicked"] {
            assert!(!said.contains(word), "{line}: {said}");
        }
    }
    let left: Vec<_> = std::fs::read_dir(at).unwrap().flatten().collect();
    assert_eq!(left.len(), 2, "runs and one.csv: {left:?}");
}

/// The remedy is in the message: what is too large, which option is wrong, which unit, which key, which runs there are.
#[test]
fn a_mistake_is_answered_with_the_text_to_write() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    succeed(
        at,
        "track --target 0um --duration 1s --clock virtual --frames off --name one",
    );
    for (text, line, words) in [
        (
            "[limits]\nhigh_um = 1e9\n",
            "rig check rig.toml",
            "rig.toml:2: high_um = 1000000000 um: must be at most",
        ),
        (
            "[calibration]\npixel = 0.1\n",
            "rig check rig.toml",
            "rig.toml:2: pixel = 0.1: has no unit: write \"0.1um\"",
        ),
        ("", "track --target 0um --sine 500um@1Hz", "--sine 500um"),
        ("", "design --model eq6 --delay 2.5", "write 2.5ms"),
        (
            "",
            "report latest-passages",
            "no run named passages; there are one",
        ),
    ] {
        std::fs::write(at.join("rig.toml"), text).unwrap();
        let ran = cellpos(at, line);
        assert_ne!(ran.code, Some(0), "{line}");
        let said =
            [&ran.out, &ran.err].map(|text| text.split_whitespace().collect::<Vec<_>>().join(" "));
        assert!(
            said.iter().any(|said| said.contains(words)),
            "{line}: {said:?}"
        );
    }
}

/// On standard output stands what was exported, and nothing else.
#[cfg(unix)]
#[test]
fn an_export_goes_down_a_pipe() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    succeed(
        at,
        "track --target 0um --duration 1s --clock virtual --frames off --ideal --name one",
    );
    for out in ["-", "/dev/stdout"] {
        let line = format!("export latest-one --out {out} --columns seq --to 2ms");
        assert_eq!(succeed(at, &line).out, "seq\n0\n1\n2\n");
    }
}

/// A page, a table or a model for a device goes to the device.
#[cfg(unix)]
#[test]
fn a_device_is_written_to_and_never_replaced() {
    use std::os::unix::fs::FileTypeExt;
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    succeed(
        at,
        "track --target 0um --duration 3s --clock virtual --frames off --name one",
    );
    for line in [
        "export latest-one --out pipe",
        "report latest-one --out pipe",
        "simulate --model eq6 --input latest-one --out pipe",
        "design --model eq6 --out pipe",
    ] {
        let pipe = at.join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let held = std::fs::OpenOptions::new()
            .read(true)
            .write(true)
            .open(&pipe)
            .unwrap();
        let reader = std::thread::spawn({
            let mut held = held.try_clone().unwrap();
            move || {
                use std::io::Read;
                let mut block = [0; 4096];
                let mut all = 0;
                // Text holds no zero byte: the one at the end says that all has come.
                loop {
                    let count = held.read(&mut block).unwrap();
                    all += count;
                    if block[..count].ends_with(&[0]) {
                        return all;
                    }
                }
            }
        });
        succeed(at, line);
        {
            use std::io::Write;
            (&held).write_all(&[0]).unwrap();
        }
        assert!(reader.join().unwrap() > 20, "{line}");
        let kind = std::fs::symlink_metadata(&pipe).unwrap().file_type();
        assert!(kind.is_fifo(), "{line}");
        std::fs::remove_file(pipe).unwrap();
    }
}
