//! The PZT board on ARM's MPS2 AN386 (Cortex-M4F, 25 MHz), as QEMU runs it.
//!
//! UART 0 is the line to the host. UART 1 takes the place of the converter's SPI. Each new code, and every 10 ms the present one,
//! is sent as three bytes `1000 0Lcc`, `0ccc cccc`, `0ccc cccc` (L: LED, c: code, highest bit first). So a listener can start
//! anywhere in the stream. A free-running counter is the clock. The output is updated every 100 us. A hardware watchdog resets a
//! firmware that hangs, and the reset sets the output to its power-up code.
//!
//! No interrupt, no allocation, no floating point. The panic handler calls a function that exists nowhere: were there a
//! panic path anywhere in this firmware, it would not link.
#![no_std]
#![no_main]

mod hardware;

use cellpos_board::{Board, Config};
use hardware::{Counter, Led, Uart, Watchdog};

/// The drive of the paper; the converter shows mid-stroke after power-up.
const CONFIG: Config = Config {
    serial: 386,
    ..Config::DEFAULT
};

/// The life of the firmware, after memory has been set up.
fn run(line: &Uart, converter: &Uart, counter: &Counter, led: &Led, watchdog: &Watchdog) {
    // The configuration is a constant that the tests check.
    let Ok(mut board) = Board::new(CONFIG) else {
        return;
    };
    let (mut now_us, mut tick_us) = (0_u64, 0_u64);
    let mut cycles = counter.cycles();
    let (mut shown, mut show_again_us) = (None, 0);
    let mut waiting = Pending::default();
    loop {
        // Whole microseconds; the rest stays in the counter.
        let passed_us = cycles.wrapping_sub(counter.cycles()) / Counter::CYCLES_PER_US;
        cycles = cycles.wrapping_sub(passed_us * Counter::CYCLES_PER_US);
        now_us += u64::from(passed_us);
        let mut heard = false;
        while let Some(byte) = line.take() {
            board.receive(&[byte], now_us);
            heard = true;
        }
        if now_us >= tick_us {
            tick_us = now_us + u64::from(CONFIG.update_us);
            watchdog.feed();
            let output = (board.tick(now_us), board.led());
            if shown != Some(output) || now_us >= show_again_us {
                shown = Some(output);
                show_again_us = now_us + 10_000;
                show(converter, output);
                led.set(output.1);
            }
        }
        while line.has_room() {
            match waiting.next(&mut board) {
                Some(byte) => line.give(byte),
                None => break,
            }
        }
        if !heard {
            hardware::pause();
        }
    }
}

/// Bytes for the host, collected from the board a few at a time.
#[derive(Default)]
struct Pending {
    bytes: [u8; 32],
    next: usize,
    count: usize,
}

impl Pending {
    fn next(&mut self, board: &mut Board) -> Option<u8> {
        if self.next >= self.count {
            self.count = board.transmit(&mut self.bytes);
            self.next = 0;
        }
        if self.count == 0 {
            return None;
        }
        let byte = self.bytes.get(self.next).copied();
        self.next += 1;
        byte
    }
}

/// Hands a code to the converter.
fn show(converter: &Uart, (code, led): (u16, bool)) {
    let led = u8::from(led) << 2;
    for byte in [
        0x80 | led | (code >> 14) as u8,
        (code >> 7) as u8 & 0x7f,
        code as u8 & 0x7f,
    ] {
        while !converter.has_room() {}
        converter.give(byte);
    }
}

/// Called by the reset code.
fn main() -> ! {
    let (line, converter) = (Uart::line(), Uart::converter());
    let watchdog = Watchdog::start();
    run(&line, &converter, &Counter::start(), &Led::new(), &watchdog);
    // Never fed again: the watchdog resets the board.
    loop {}
}

unsafe extern "C" {
    /// Exists nowhere: see the module's documentation.
    safe fn a_panic_path_is_linked() -> !;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    a_panic_path_is_linked()
}
