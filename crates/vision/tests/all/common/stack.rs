//! Recorded stacks beside the project.

use cellpos_vision::{Frame, Pixels};
use std::path::{Path, PathBuf};
use tiff::decoder::{Decoder, DecodingResult, Limits};

/// Folder of the cells in channels.
pub(crate) const CELLS: &str = concat!(env!("MEASURED_DATA"), "/cells-in-channels");

/// Frames of 8 bits.
pub(crate) struct Stack {
    pub width: usize,
    pub height: usize,
    pub pages: Vec<Vec<u8>>,
}

impl Stack {
    pub(crate) fn open(folder: &str, file: &str) -> Self {
        Self::read(&Path::new(CELLS).join(folder).join(file))
    }

    pub(crate) fn read(path: &PathBuf) -> Self {
        let file = std::fs::File::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let mut decoder = Decoder::new(file).unwrap().with_limits(Limits::unlimited());
        let (width, height) = decoder.dimensions().unwrap();
        let mut pages = Vec::new();
        loop {
            pages.push(match decoder.read_image().unwrap() {
                DecodingResult::U8(p) => p,
                DecodingResult::U16(p) => p.iter().map(|v| (*v).min(255) as u8).collect(),
                _ => panic!("{}: neither 8 nor 16 bits", path.display()),
            });
            if !decoder.more_images() {
                break;
            }
            decoder.next_image().unwrap();
        }
        Stack {
            width: width as usize,
            height: height as usize,
            pages,
        }
    }

    pub(crate) fn frames(&self) -> impl Iterator<Item = Frame<'_>> {
        self.pages.iter().map(|p| Frame {
            width: self.width,
            height: self.height,
            pixels: Pixels::Mono8(p),
        })
    }
}

/// The instrument's masks of a folder.
pub(crate) fn masks(folder: &str) -> Vec<Vec<u8>> {
    Stack::open(folder, "masks.tif").pages
}
