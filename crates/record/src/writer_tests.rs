use super::*;
use crate::columns::GROUPS;
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
    removed: Rc<RefCell<bool>>,
    /// Whether a sync fails, as after an error of the medium.
    forgets: Rc<RefCell<bool>>,
    syncs: Rc<RefCell<u64>>,
}

impl Disk {
    fn new(room: usize) -> Self {
        Self {
            bytes: Rc::default(),
            room: Rc::new(RefCell::new(room)),
            stuck: Rc::default(),
            removed: Rc::default(),
            forgets: Rc::default(),
            syncs: Rc::default(),
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
        *self.syncs.borrow_mut() += 1;
        if *self.forgets.borrow() {
            return Err(io::Error::other("input/output error"));
        }
        Ok(())
    }

    fn is_there(&self) -> io::Result<()> {
        if *self.removed.borrow() {
            return Err(io::Error::other("removed"));
        }
        Ok(())
    }
}

fn row(seq: u64) -> TickRecord {
    let mut row = TickRecord::unknown();
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
    let mut stream = Stream::new(Cursor::new(bytes), 0).unwrap();
    let mut seqs = Vec::new();
    while let Some(batch) = stream.next_batch().unwrap() {
        seqs.extend(batch.iter().map(|row| row.seq));
    }
    (seqs, stream.damaged_bytes, stream.torn_bytes)
}

fn log(ticks: &Disk, events: &Disk, rows: usize) -> Log<Disk> {
    let blocks = |disk: &Disk| Blocks::new(disk.clone(), 0);
    Log::new(blocks(ticks), blocks(events), policy(rows), &GROUPS, &[]).unwrap()
}

#[test]
fn what_a_full_disk_refuses_waits_and_is_there_when_there_is_room_again() {
    for stuck in [false, true] {
        let (ticks, events) = (Disk::new(30_000), Disk::new(200));
        let mut log = log(&ticks, &events, 10);
        *ticks.stuck.borrow_mut() = stuck;
        for seq in 0..500 {
            log.tick(&row(seq));
            if seq % 50 == 0 {
                log.event(&Event::new(seq as f64, "mark"));
            }
        }
        assert!(log.failing);
        let faults = log.faults();
        assert!(faults.rows_lost > 0 && faults.events_lost > 0 && faults.first.is_some());
        // Somebody deletes files.
        *ticks.room.borrow_mut() = usize::MAX;
        *events.room.borrow_mut() = usize::MAX;
        *ticks.stuck.borrow_mut() = false;
        for seq in 500..600 {
            log.tick(&row(seq));
        }
        assert!(!log.failing);
        log.close(Duration::ZERO);
        assert_eq!((log.faults().rows_lost, log.faults().events_lost), (0, 0));
        let (seqs, damaged, torn) = read(&ticks.bytes.borrow());
        assert_eq!(seqs, (0..600).collect::<Vec<u64>>());
        assert_eq!((damaged, torn), (0, 0), "no half batch stays behind");
        let log = events.bytes.borrow();
        assert_eq!(log.iter().filter(|byte| **byte == b'\n').count(), 10);
        assert!(log.ends_with(b"\n"), "no half line stays behind");
    }
}

#[test]
fn a_disk_that_is_full_from_the_start_loses_everything_by_number() {
    let mut log = log(&Disk::new(0), &Disk::new(0), 4);
    for seq in 0..10 {
        log.tick(&row(seq));
    }
    log.event(&Event::new(0.0, "x"));
    log.close(Duration::ZERO);
    assert!(log.failing);
    assert_eq!(log.faults().rows_lost, 10);
    assert_eq!(log.faults().events_lost, 1);
}

#[test]
fn a_file_that_was_removed_is_noticed_with_the_next_batch() {
    let (ticks, events) = (Disk::new(usize::MAX), Disk::new(usize::MAX));
    let mut log = log(&ticks, &events, 10);
    (0..10).for_each(|seq| log.tick(&row(seq)));
    assert!(!log.failing);
    *ticks.removed.borrow_mut() = true;
    (10..20).for_each(|seq| log.tick(&row(seq)));
    assert!(log.failing);
    assert_eq!(log.faults().rows_lost, 10);
}

#[test]
fn events_go_to_the_disk_with_their_ticks_and_cost_no_wait_of_their_own() {
    let (ticks, events) = (Disk::new(usize::MAX), Disk::new(usize::MAX));
    let mut log = log(&ticks, &events, 100);
    let before = *ticks.syncs.borrow() + *events.syncs.borrow();
    for seq in 0..1000 {
        log.tick(&row(seq));
        log.event(&Event::new(seq as f64, "frame-repeated"));
    }
    let syncs = *ticks.syncs.borrow() + *events.syncs.borrow() - before;
    assert!(syncs <= 20, "{syncs} waits for ten batches");
    log.close(Duration::ZERO);
    let written = events.bytes.borrow();
    assert_eq!(written.iter().filter(|byte| **byte == b'\n').count(), 1000);
}

#[test]
fn rows_that_the_disk_says_it_does_not_have_are_counted() {
    let (ticks, events) = (Disk::new(usize::MAX), Disk::new(usize::MAX));
    let mut log = log(&ticks, &events, 10);
    *ticks.forgets.borrow_mut() = true;
    (0..10).for_each(|seq| log.tick(&row(seq)));
    *ticks.forgets.borrow_mut() = false;
    (10..20).for_each(|seq| log.tick(&row(seq)));
    assert!(!log.failing);
    assert_eq!(log.faults().rows_lost, 10);
}

#[test]
fn a_run_cut_off_at_any_byte_reads_back_to_its_last_whole_batch() {
    let disk = Disk::new(usize::MAX);
    let mut ends = Vec::new();
    let mut log = log(&disk, &Disk::new(usize::MAX), 8);
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
