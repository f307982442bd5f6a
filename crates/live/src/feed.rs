//! Passes data from the threads of a run to the page without waiting.

use crate::row::{OUTLINE_POINTS, PICTURE_MARGIN, Picture, Row};
use crate::state::{ClipLine, CycleRow, EventLine, Hello, State};
use rtrb::{Consumer, Producer, RingBuffer};

/// Rows that fit while the hub is not running: eight seconds at 1 kHz.
const ROWS: usize = 8192;
/// Events, states and cycles that fit.
const LINES: usize = 1024;
/// Pictures on their way.
const PICTURES: usize = 3;
/// Time between two pictures, s.
const PICTURE_EVERY_S: f64 = 1.0 / 15.0;

/// Items lost to a full ring since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Lost {
    /// Rows.
    pub rows: u64,
    /// Events, states, cycles.
    pub lines: u64,
    /// Pictures.
    pub pictures: u64,
}

/// The items of the ring of words.
#[derive(Debug, Clone, PartialEq)]
pub enum Line {
    /// How the run stands.
    State(Box<State>),
    /// What happened.
    Event(EventLine),
    /// A cycle is over.
    Cycle(CycleRow),
    /// A clip is on the disk.
    Clip(ClipLine),
}

/// The run's end of the rings. No call waits; [`Feed::lost`] counts the items that did not fit.
#[derive(Debug)]
pub struct Feed {
    rows: Producer<Row>,
    lines: Producer<Line>,
    pictures: Option<PictureFeed>,
    lost: Lost,
}

/// The part of a feed for the thread that has the frames: takes pictures without allocating.
#[derive(Debug)]
pub struct PictureFeed {
    filled: Producer<Picture>,
    empty: Consumer<Picture>,
    next_s: f64,
    lost: u64,
}

/// The server's end of the rings.
#[derive(Debug)]
pub struct FeedHub {
    pub(crate) hello: Hello,
    pub(crate) rows: Consumer<Row>,
    pub(crate) lines: Consumer<Line>,
    pub(crate) filled: Consumer<Picture>,
    pub(crate) empty: Producer<Picture>,
}

impl Feed {
    /// Both ends of the rings of a run.
    pub fn new(hello: Hello) -> (Self, FeedHub) {
        let (rows, rows_out) = RingBuffer::new(ROWS);
        let (lines, lines_out) = RingBuffer::new(LINES);
        let (filled, filled_out) = RingBuffer::new(PICTURES);
        let (mut empty, empty_out) = RingBuffer::new(PICTURES);
        while empty.slots() > 0 {
            let _ = empty.push(Picture {
                width: 0,
                height: 0,
                pixels: Vec::with_capacity(if hello.pictures { PICTURE_MARGIN } else { 0 }),
                um_per_px: f32::NAN,
                upright: false,
                first_um: f32::NAN,
                centre_px: [f32::NAN; 2],
                half_px: [f32::NAN; 2],
                outline_px: Vec::with_capacity(if hello.pictures { OUTLINE_POINTS } else { 0 }),
                gate_px: f32::NAN,
                time_s: f32::NAN,
            });
        }
        let pictures = PictureFeed {
            filled,
            empty: empty_out,
            next_s: f64::NEG_INFINITY,
            lost: 0,
        };
        let feed = Self {
            rows,
            lines,
            pictures: Some(pictures),
            lost: Lost::default(),
        };
        let hub = FeedHub {
            hello,
            rows: rows_out,
            lines: lines_out,
            filled: filled_out,
            empty,
        };
        (feed, hub)
    }

    /// The part for the thread that has the frames; once.
    pub fn take_pictures(&mut self) -> Option<PictureFeed> {
        self.pictures.take()
    }

    /// One tick.
    pub fn row(&mut self, row: &Row) {
        self.lost.rows += u64::from(self.rows.push(*row).is_err());
    }

    /// Takes the state of the run; a few calls a second are enough.
    pub fn state(&mut self, state: State) {
        self.line(Line::State(Box::new(state)));
    }

    /// What happened.
    pub fn event(&mut self, event: EventLine) {
        self.line(Line::Event(event));
    }

    /// A cycle is over.
    pub fn cycle(&mut self, cycle: CycleRow) {
        self.line(Line::Cycle(cycle));
    }

    /// A clip is on the disk.
    pub fn clip(&mut self, clip: ClipLine) {
        self.line(Line::Clip(clip));
    }

    fn line(&mut self, line: Line) {
        self.lost.lines += u64::from(self.lines.push(line).is_err());
    }

    /// What did not fit.
    pub fn lost(&self) -> Lost {
        self.lost
    }
}

impl FeedHub {
    /// The run.
    pub fn hello(&self) -> &Hello {
        &self.hello
    }

    /// The next tick, for callers that show a run without a server.
    pub fn next_row(&mut self) -> Option<Row> {
        self.rows.pop().ok()
    }

    /// The next message in words, if any.
    pub fn next_line(&mut self) -> Option<Line> {
        self.lines.pop().ok()
    }
}

impl PictureFeed {
    /// Whether a picture is due at this time of the run, s; fifteen a second are due.
    pub fn is_due(&self, time_s: f64) -> bool {
        time_s >= self.next_s
    }

    /// Fills a picture and sends it. `fill` gets an empty vector with room for [`PICTURE_MARGIN`] pixels within [`Picture::pixels`], and
    /// for [`OUTLINE_POINTS`] points of an outline, so that it need not allocate. It sends nothing if no picture is empty or the filled
    /// one is invalid.
    pub fn offer(&mut self, time_s: f64, fill: impl FnOnce(&mut Picture)) {
        self.next_s = time_s + PICTURE_EVERY_S;
        let Ok(mut picture) = self.empty.pop() else {
            self.lost += 1;
            return;
        };
        picture.pixels.clear();
        picture.outline_px.clear();
        fill(&mut picture);
        picture.time_s = time_s as f32;
        // As many pictures exist as the ring has room for.
        let _ = self.filled.push(picture);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_feed_that_nobody_reads_counts_and_goes_on() {
        let (mut feed, hub) = Feed::new(Hello::default());
        for seq in 0..ROWS as u32 + 10 {
            feed.row(&Row {
                seq,
                ..Row::default()
            });
        }
        for _ in 0..LINES + 3 {
            feed.state(State::default());
        }
        let mut pictures = feed.take_pictures().unwrap();
        assert!(feed.take_pictures().is_none());
        for n in 0..PICTURES + 2 {
            pictures.offer(n as f64, |picture| picture.width = 1);
        }
        assert_eq!(feed.lost().rows, 10);
        assert_eq!(feed.lost().lines, 3);
        assert_eq!(pictures.lost, 2);
        assert_eq!(hub.rows.slots(), ROWS);
    }

    #[test]
    fn fifteen_pictures_a_second_are_due() {
        let (mut feed, mut hub) = Feed::new(Hello::default());
        let mut pictures = feed.take_pictures().unwrap();
        let mut sent = 0;
        for tick in 0..1000 {
            let time_s = f64::from(tick) * 1e-3;
            if pictures.is_due(time_s) {
                pictures.offer(time_s, |_| ());
                sent += 1;
                let picture = hub.filled.pop().unwrap();
                hub.empty.push(picture).unwrap();
            }
        }
        assert_eq!(sent, 15);
    }
}
