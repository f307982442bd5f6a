//! An emulated rig in this process: the firmware library, the plant and the rendered camera.
//!
//! Camera and actuator share one [`RigInABox`] behind a lock; only I/O threads touch it. The world follows its clock, real or
//! virtual, at each access; virtual time does not advance in between.

use crate::board_config::BoardConfig;
use crate::config::WorldConfig;
use crate::partner::PressureConfig;
use crate::rig_in_a_box::{BoxError, RigInABox};
use cellpos_drivers::{BoardHost, Calibration, Port};
use cellpos_plant::Model;
use cellpos_rig::clock::Clock;
use cellpos_rig::measurement::Measurement;
use cellpos_rig::source::{
    Camera, CameraError, FrameBuffer, FrameStamp, PositionSource, SourceInfo,
};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A box shared by camera and actuator.
#[derive(Debug, Clone)]
pub struct EmulatedRig {
    rig: Arc<Mutex<RigInABox>>,
    clock: Clock,
}

impl EmulatedRig {
    /// A rig that was just switched on.
    ///
    /// # Errors
    /// [`BoxError`] names the invalid value.
    pub fn new(
        board: BoardConfig,
        world: &WorldConfig,
        model: &Model,
        clock: Clock,
    ) -> Result<Self, BoxError> {
        let rig = RigInABox::new(board, world, model, clock.now_ns())?;
        Ok(Self {
            rig: Arc::new(Mutex::new(rig)),
            clock,
        })
    }

    /// The same with a slow partner of the PZT.
    ///
    /// # Errors
    /// The board of the partner is invalid.
    pub fn with_partner(
        board: BoardConfig,
        world: &WorldConfig,
        model: &Model,
        clock: Clock,
        partner: &PressureConfig,
    ) -> Result<Self, BoxError> {
        let rig = RigInABox::new(board, world, model, clock.now_ns())?.with_partner(partner)?;
        Ok(Self {
            rig: Arc::new(Mutex::new(rig)),
            clock,
        })
    }

    /// The box, brought up to the present.
    pub fn now(&self) -> MutexGuard<'_, RigInABox> {
        // The world is valid even if a thread panicked while it held the lock.
        let mut rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        let now_ns = self.clock.now_ns();
        rig.advance_to(now_ns);
        rig
    }

    /// The clock it lives on.
    pub fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Its board, at the end of an emulated line.
    ///
    /// # Errors
    /// As [`BoardHost::connect`].
    pub fn actuator(&self) -> Result<BoardHost<EmulatedPort>, cellpos_rig::ActuatorError> {
        BoardHost::connect(self.port(), self.clock.clone())
    }

    /// The line to its board.
    pub fn port(&self) -> EmulatedPort {
        EmulatedPort {
            rig: self.clone(),
            partner: false,
        }
    }

    /// The partner of the PZT, at the end of an emulated line.
    ///
    /// # Errors
    /// As [`BoardHost::connect`].
    pub fn partner(&self) -> Result<BoardHost<EmulatedPort>, cellpos_rig::ActuatorError> {
        let port = EmulatedPort {
            rig: self.clone(),
            partner: true,
        };
        BoardHost::connect(port, self.clock.clone())
    }

    /// Its camera: frames. Use either this or [`EmulatedRig::positions`], not both.
    pub fn camera(&self) -> EmulatedCamera {
        EmulatedCamera { rig: self.clone() }
    }

    /// Its camera without pictures: positions with the noise that pictures would give.
    pub fn positions(&self) -> EmulatedPositions {
        EmulatedPositions { rig: self.clone() }
    }

    /// The calibration of its camera.
    pub fn calibration(&self) -> Calibration {
        Self::calibration_of(self.now().world().config())
    }

    /// The calibration of the camera of such a world.
    pub fn calibration_of(config: &WorldConfig) -> Calibration {
        Calibration {
            tilt_deg: config.imperfections().tilt_deg,
            origin_across_px: config.origin_y_px(),
            ..Calibration::along_rows(config.pixel_um, config.origin_x_px(), 1.0)
        }
    }

    /// Waits for the next delivery until `deadline_ns` and takes it.
    fn wait<T>(
        &self,
        deadline_ns: i64,
        take: impl Fn(&mut RigInABox) -> Option<T>,
    ) -> Option<(T, i64, f64, f64)> {
        /// Time to sleep if no exposure has begun yet.
        const LOOK_EVERY_NS: i64 = 200_000;
        loop {
            let wake_ns = {
                let mut rig = self.now();
                if let Some(taken) = take(&mut rig) {
                    return Some((
                        taken,
                        rig.now_ns(),
                        rig.world().bead_um(),
                        rig.world().pzt_um(),
                    ));
                }
                let now_ns = rig.now_ns();
                if now_ns >= deadline_ns {
                    return None;
                }
                rig.world()
                    .next_delivery_ns()
                    .map_or(now_ns + LOOK_EVERY_NS, |delivery_ns| {
                        delivery_ns.max(now_ns + 1)
                    })
            };
            self.clock.sleep_until_ns(wake_ns.min(deadline_ns));
        }
    }

    fn info(&self, name: &str, pictures: bool) -> SourceInfo {
        let rig = self.now();
        let config = rig.world().config();
        let half_um = config.origin_x_px() * config.pixel_um;
        SourceInfo {
            name: name.to_string(),
            width_px: if pictures {
                usize::from(config.width_px)
            } else {
                0
            },
            height_px: if pictures {
                usize::from(config.height_px)
            } else {
                0
            },
            rate_hz: config.rate_hz,
            latency_ms: config.latency_ms,
            exposure_s: config.exposure_ms * 1e-3,
            field_um: [-half_um, half_um],
        }
    }
}

/// The line to the emulated board.
#[derive(Debug, Clone)]
pub struct EmulatedPort {
    rig: EmulatedRig,
    /// It leads to the slow partner.
    partner: bool,
}

impl Port for EmulatedPort {
    fn name(&self) -> &str {
        if self.partner {
            "emulated partner"
        } else {
            "emulated"
        }
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut rig = self.rig.now();
        let now_ns = rig.now_ns();
        if self.partner {
            rig.receive_partner(bytes, now_ns);
        } else {
            rig.receive(bytes, now_ns);
        }
        Ok(bytes.len())
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let mut rig = self.rig.now();
        Ok(if self.partner {
            rig.transmit_partner(buffer)
        } else {
            rig.transmit(buffer)
        })
    }
}

/// The emulated camera.
#[derive(Debug, Clone)]
pub struct EmulatedCamera {
    rig: EmulatedRig,
}

impl Camera for EmulatedCamera {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        buffer.bits = 8;
        let pixels = std::cell::RefCell::new(&mut buffer.mono8);
        let taken = self.rig.wait(deadline_ns, |rig| {
            rig.world_mut().take_frame(&mut pixels.borrow_mut())
        });
        let Some((info, arrival_ns, true_um, true_pzt_um)) = taken else {
            return Ok(None);
        };
        (buffer.width, buffer.height) = {
            let rig = self.rig.now();
            let config = rig.world().config();
            (usize::from(config.width_px), usize::from(config.height_px))
        };
        Ok(Some(FrameStamp {
            id: info.id,
            mid_exposure_ns: info.mid_exposure_ns,
            exposure_ns: info.exposure_ns,
            arrival_ns,
            true_um,
            true_pzt_um,
        }))
    }

    fn truth_um(&mut self) -> f64 {
        self.rig.now().world().bead_um()
    }

    fn info(&self) -> SourceInfo {
        self.rig.info("emulated camera", true)
    }
}

/// The emulated camera without pictures.
#[derive(Debug, Clone)]
pub struct EmulatedPositions {
    rig: EmulatedRig,
}

impl PositionSource for EmulatedPositions {
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError> {
        let taken = self
            .rig
            .wait(deadline_ns, |rig| rig.world_mut().take_position());
        Ok(
            taken.map(|(fix, ready_ns, true_um, true_pzt_um)| Measurement {
                frame_id: fix.info.id,
                mid_exposure_ns: fix.info.mid_exposure_ns,
                ready_ns,
                position_um: fix.x_um,
                variance_um2: fix.variance_um2,
                verdict: fix.verdict,
                track: None,
                snr: fix.snr,
                length_um: fix.length_um,
                area_um2: fix.area_um2,
                length_sd_um: fix.length_sd_um,
                area_sd_um2: fix.area_sd_um2,
                true_um,
                true_pzt_um,
            }),
        )
    }

    fn truth_um(&mut self) -> f64 {
        self.rig.now().world().bead_um()
    }

    fn info(&self) -> SourceInfo {
        self.rig.info("emulated positions", false)
    }
}
