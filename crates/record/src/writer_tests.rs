use super::*;
use crate::columns;
use crate::stream::Stream;
use std::cell::RefCell;
use std::io::Cursor;
use std::rc::Rc;

/// A disk of limited size that can be emptied, and that keeps half a block when it fills up, as real ones do.
#[derive(Clone)]
struct Disk {
    bytes: Rc<RefCell<Vec<u8>>>,
    room: Rc<RefCell<usize>>,
    /// Whether cutting fails as well.
    stuck: Rc<RefCell<bool>>,
}

impl Disk {
    fn new(room: usize) -> Self {
        Self {
            bytes: Rc::default(),
            room: Rc::new(RefCell::new(room)),
            stuck: Rc::default(),
        }
    }
}

impl Sink for Disk {
    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut file = self.bytes.borrow_mut();
        let fits = self
            .room
            .borrow()
            .saturating_sub(file.len())
            .min(bytes.len());
        file.extend_from_slice(&bytes[..fits]);
        if fits < bytes.len() {
            return Err(io::Error::from(io::ErrorKind::StorageFull));
        }
        Ok(())
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        if *self.stuck.borrow() {
            return Err(io::Error::from(io::ErrorKind::StorageFull));
        }
        self.bytes.borrow_mut().truncate(length as usize);
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn row(seq: u64) -> TickRecord {
    let mut row = columns::unknown();
    row.seq = seq;
    row.command_um = seq as f64;
    row
}

fn policy(rows: usize) -> FlushPolicy {
    FlushPolicy {
        rows,
        interval: None,
        sync: true,
    }
}

fn read(bytes: &[u8]) -> (Vec<u64>, u64, u64) {
    let mut stream = Stream::new(Cursor::new(bytes)).unwrap();
    let mut seqs = Vec::new();
    while let Some(batch) = stream.next_batch().unwrap() {
        seqs.extend(batch.iter().map(|row| row.seq));
    }
    (seqs, stream.damaged_bytes, stream.torn_bytes)
}

#[test]
fn a_full_disk_is_counted_and_the_run_goes_on_when_there_is_room_again() {
    for stuck in [false, true] {
        let (ticks, events) = (Disk::new(60_000), Disk::new(200));
        let mut log = Log::new(
            Blocks::new(ticks.clone(), 0),
            Blocks::new(events.clone(), 0),
            policy(10),
            true,
        )
        .unwrap();
        *ticks.stuck.borrow_mut() = stuck;
        for seq in 0..500 {
            log.tick(&row(seq));
            if seq % 50 == 0 {
                log.event(&Event::new(seq as f64, "mark"));
            }
        }
        let lost = log.faults.rows_lost;
        assert!(lost > 0 && log.faults.events_lost > 0);
        assert_eq!(
            lost + log.rows,
            500,
            "every row is either written or counted"
        );
        assert!(log.faults.first.is_some());
        // Somebody deletes files: the record goes on behind its last whole batch.
        *ticks.room.borrow_mut() = usize::MAX;
        *ticks.stuck.borrow_mut() = false;
        for seq in 500..600 {
            log.tick(&row(seq));
        }
        log.close();
        assert_eq!(log.faults.rows_lost, lost);
        let (seqs, damaged, torn) = read(&ticks.bytes.borrow());
        assert_eq!(seqs.len() as u64, 600 - lost);
        assert_eq!(seqs.last(), Some(&599));
        assert_eq!((damaged, torn), (0, 0), "no half batch stays behind");
        let log = events.bytes.borrow();
        assert!(log.ends_with(b"\n"), "no half line stays behind");
    }
}

#[test]
fn a_disk_that_is_full_from_the_start_stops_nothing() {
    let mut log = Log::new(
        Blocks::new(Disk::new(0), 0),
        Blocks::new(Disk::new(0), 0),
        policy(4),
        true,
    )
    .unwrap();
    for seq in 0..10 {
        log.tick(&row(seq));
    }
    log.event(&Event::new(0.0, "x"));
    log.close();
    assert_eq!(log.faults.rows_lost, 10);
    assert_eq!(log.faults.events_lost, 1);
    assert_eq!(log.rows, 0);
}

#[test]
fn a_run_cut_off_at_any_byte_reads_back_to_its_last_whole_batch() {
    let disk = Disk::new(usize::MAX);
    let mut ends = Vec::new();
    let mut log = Log::new(
        Blocks::new(disk.clone(), 0),
        Blocks::new(Disk::new(usize::MAX), 0),
        policy(8),
        true,
    )
    .unwrap();
    for seq in 0..40 {
        log.tick(&row(seq));
        if seq % 8 == 7 {
            ends.push(disk.bytes.borrow().len());
        }
    }
    let whole = disk.bytes.borrow();
    for length in 0..=whole.len() {
        let (seqs, damaged, torn) = read(&whole[..length]);
        let batches = ends.iter().filter(|end| **end <= length).count();
        assert_eq!(
            seqs,
            (0..8 * batches as u64).collect::<Vec<_>>(),
            "cut at byte {length}"
        );
        assert_eq!(damaged, 0);
        let last = ends.iter().copied().filter(|end| *end <= length).max();
        if let Some(last) = last {
            assert_eq!(torn as usize, length - last);
        }
    }
}
