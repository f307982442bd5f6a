//! The PZT board on a Raspberry Pi Pico 2 (RP2350): USB CDC to the host, a 16-bit converter on SPI.
//!
//! A task that interrupts all others updates the output every 100 us; it alone feeds the hardware watchdog. So a firmware that
//! answers but no longer steps is reset after 5 ms. After such a reset the output ramps to park from where the ADC sees it; after
//! power-up it is at the converter's code 0. Where the output does not show what was written, the board parks and
//! the Pico's LED blinks. A panic ends in the watchdog's reset.
#![no_std]
#![no_main]

mod converter;

use cellpos_board::{Board, Config};
use cellpos_link::{MAX_FRAME, ToBoard, encode};
use converter::{Converter, Wires};
use core::cell::RefCell;
use embassy_executor::{InterruptExecutor, Spawner};
use embassy_futures::join::join3;
use embassy_rp::gpio::{Level, Output};
use embassy_rp::interrupt::{InterruptExt, Priority};
use embassy_rp::peripherals::USB;
use embassy_rp::watchdog::{ResetReason, Watchdog};
use embassy_rp::{bind_interrupts, interrupt, usb};
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_time::{Duration, Instant, Ticker, Timer};
use embassy_usb::class::cdc_acm::{CdcAcmClass, Receiver, Sender, State};
use static_cell::StaticCell;

/// The drive of the paper, 0 to 40 um; code 0 is what both converters show after power-up.
const CONFIG: Config = Config {
    serial: 2350,
    power_up_pm: Config::DEFAULT.limits.low_pm,
    ..Config::DEFAULT
};
/// Longest silence of the output task.
const WATCHDOG: Duration = Duration::from_millis(5);
/// Longest packet of full-speed USB.
const PACKET: usize = 64;

static BOARD: Mutex<CriticalSectionRawMutex, RefCell<Option<Board>>> =
    Mutex::new(RefCell::new(None));
static ABOVE_ALL: InterruptExecutor = InterruptExecutor::new();

bind_interrupts!(struct Irqs {
    USBCTRL_IRQ => usb::InterruptHandler<USB>;
});

#[interrupt]
unsafe fn SWI_IRQ_0() {
    // SAFETY: called by this interrupt alone.
    unsafe { ABOVE_ALL.on_interrupt() }
}

/// The board, for some microseconds.
fn with_board<T>(what: impl FnOnce(&mut Board) -> T) -> Option<T> {
    BOARD.lock(|board| board.borrow_mut().as_mut().map(what))
}

fn now_us() -> u64 {
    Instant::now().as_micros()
}

/// Displacement of a code, pm.
fn displacement_pm(code: u16) -> i32 {
    let (low, high) = (
        i64::from(CONFIG.limits.low_pm),
        i64::from(CONFIG.limits.high_pm),
    );
    (low + i64::from(code) * (high - low) / i64::from(CONFIG.highest_code())) as i32
}

/// The board parks, as if the host had asked for it.
fn park() {
    let mut wire = [0; MAX_FRAME];
    if let Ok(length) = encode(&ToBoard::Park, &mut wire) {
        let now_us = now_us();
        with_board(|board| board.receive(wire.get(..length).unwrap_or(&[]), now_us));
    }
}

/// Every 100 us: steps the board, writes the converter, feeds the watchdog.
#[embassy_executor::task]
async fn output(
    mut converter: Converter,
    mut watchdog: Watchdog,
    mut light: Output<'static>,
    mut own_led: Output<'static>,
) {
    let mut ticker = Ticker::every(Duration::from_micros(u64::from(CONFIG.update_us)));
    let mut failed_at_us = None;
    loop {
        let now_us = now_us();
        let Some((code, lit)) = with_board(|board| (board.tick(now_us), board.led())) else {
            return;
        };
        if failed_at_us.is_none() && converter.has_failed() {
            failed_at_us = Some(now_us);
            park();
        }
        converter.write(code);
        light.set_level(if lit { Level::High } else { Level::Low });
        // Lit: all is well. Five times a second: the output does not show what was written.
        let blink = failed_at_us.is_none_or(|since_us| (now_us - since_us) / 100_000 % 2 == 0);
        own_led.set_level(if blink { Level::High } else { Level::Low });
        watchdog.feed(WATCHDOG);
        ticker.next().await;
    }
}

type Driver = usb::Driver<'static, USB>;

/// Bytes of the host go to the board as they come.
async fn listen(mut line: Receiver<'static, Driver>) {
    let mut packet = [0; PACKET];
    loop {
        line.wait_connection().await;
        while let Ok(length) = line.read_packet(&mut packet).await {
            let now_us = now_us();
            with_board(|board| board.receive(packet.get(..length).unwrap_or(&[]), now_us));
        }
    }
}

/// Bytes of the board go to the host as soon as there are any: nothing gathers for a millisecond.
async fn talk(mut line: Sender<'static, Driver>) {
    let mut packet = [0; PACKET];
    loop {
        line.wait_connection().await;
        loop {
            let length = with_board(|board| board.transmit(&mut packet)).unwrap_or(0);
            if length == 0 {
                Timer::after_micros(100).await;
                continue;
            }
            if line
                .write_packet(packet.get(..length).unwrap_or(&[]))
                .await
                .is_err()
            {
                break;
            }
            // A full packet is taken for a part of a longer transfer: an empty one ends it.
            if length == PACKET && line.write_packet(&[]).await.is_err() {
                break;
            }
        }
    }
}

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let p = embassy_rp::init(Default::default());
    let mut watchdog = Watchdog::new(p.WATCHDOG);
    let mut converter = Converter::new(Wires {
        spi: p.SPI0,
        select: p.PIN_17,
        clock: p.PIN_18,
        data: p.PIN_19,
        adc: p.ADC,
        looked_at: p.PIN_26,
    });
    // The converter knows nothing of the reset of its microcontroller: it is led to park from where it stands.
    let stands = match watchdog.reset_reason() {
        Some(ResetReason::TimedOut | ResetReason::Forced) => converter.shown(),
        None => None,
    };
    let board = match stands {
        Some(code) => Board::after_reset(CONFIG, displacement_pm(code)),
        None => Board::new(CONFIG),
    };
    // The configuration is a constant that the tests of the library check; without a board nothing steps, and nothing moves.
    let Ok(board) = board else {
        return;
    };
    BOARD.lock(|place| place.replace(Some(board)));
    watchdog.start(WATCHDOG);
    interrupt::SWI_IRQ_0.set_priority(Priority::P1);
    let above_all = ABOVE_ALL.start(interrupt::SWI_IRQ_0);
    let light = Output::new(p.PIN_16, Level::Low);
    let own_led = Output::new(p.PIN_25, Level::High);
    if let Ok(task) = output(converter, watchdog, light, own_led) {
        above_all.spawn(task);
    }

    static STATE: StaticCell<State> = StaticCell::new();
    static BUFFERS: StaticCell<[[u8; 256]; 3]> = StaticCell::new();
    let [descriptor, bos, control] = BUFFERS.init([[0; 256]; 3]);
    // The test number of pid.codes: a lab that sells boards needs its own number.
    let mut about = embassy_usb::Config::new(0x1209, 0x0001);
    about.manufacturer = Some("cellpos");
    about.product = Some("PZT board");
    about.serial_number = Some("2350");
    let driver = usb::Driver::new(p.USB, Irqs);
    let mut builder = embassy_usb::Builder::new(driver, about, descriptor, bos, &mut [], control);
    let class = CdcAcmClass::new(&mut builder, STATE.init(State::new()), PACKET as u16);
    let mut device = builder.build();
    let (sender, receiver) = class.split();
    join3(device.run(), listen(receiver), talk(sender)).await;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    // Interrupts off: the output task does not feed the watchdog any more.
    cortex_m::interrupt::disable();
    loop {}
}
