//! The drive's end of the serial link ([`crate::link`]), on USART2: the ST-LINK's virtual port, and connector J3.
//!
//! Bytes come and go by the port's interrupt, which the control interrupt precedes; everything else is a task. A flood of bytes takes time
//! from tasks only.

use super::interrupt::Change;
use super::parameter_flash::{ParameterFlash, REGION};
use super::{defaults, interrupt};
use crate::commission::{Commission, Evidence, Nameplate, Progress};
use crate::control::ControlConfig;
use crate::drive::DriveConfig;
use crate::fault::{Fault, Faults};
use crate::link::frame::LONGEST;
use crate::link::message::{Identity, Refusal, Status, Telemetry, VERSION};
use crate::link::session::{Device, Session};
use crate::link::{BAUD_RATE, BUILD};
use crate::parameters::Parameters;
use crate::parameters::store::{Origin, ParameterStore};
use crate::supervisor::{Command, Mode};
use embassy_futures::select::{Either, select};
use embassy_stm32::flash::Flash;
use embassy_stm32::interrupt::{InterruptExt, Priority};
use embassy_stm32::usart::{self, BufferedInterruptHandler, BufferedUart, BufferedUartTx};
use embassy_stm32::{Peri, bind_interrupts, peripherals};
use embassy_time::Timer;
use embedded_io_async::{Read, Write};

bind_interrupts!(struct Interrupts {
    USART2 => BufferedInterruptHandler<peripherals::USART2>;
});

/// How long telemetry may wait if no byte comes from the host (ms).
const TURN: u64 = 1;

/// The serial port's pins and itself.
pub struct Port {
    pub(super) usart: Peri<'static, peripherals::USART2>,
    /// From the host.
    pub(super) rx: Peri<'static, peripherals::PB4>,
    /// To the host.
    pub(super) tx: Peri<'static, peripherals::PB3>,
}

/// The drive, for whoever is at the other end.
pub struct Link {
    status: Status,
    progress: Progress,
    parameters: Parameters,
    store: Option<ParameterStore<ParameterFlash>>,
}

impl Link {
    /// Loads the parameters: those that were saved, or else the defaults, with a fault if there is something wrong with the saved
    /// ones.
    // Not inlined: a caller would keep this stack while it calls on.
    #[inline(never)]
    pub(super) fn load(flash: Peri<'static, peripherals::FLASH>) -> (Self, Option<Fault>) {
        let flash = ParameterFlash(Flash::new_blocking(flash));
        let mut store = ParameterStore::new(flash, REGION).ok();
        let defaults = defaults::parameters();
        let loaded = store.as_mut().map(|store| store.load(&defaults));
        let (parameters, fault) = match loaded {
            Some(loaded) if loaded.origin != Origin::Unreadable => (loaded.parameters, None),
            _ => (defaults, Some(Fault::BadParameters)),
        };
        let status = Status { mode: Mode::Boot, faults: Faults::NONE, limits: Default::default() };
        (Self { status, progress: Progress::OVER, parameters, store }, fault)
    }

    /// [Prepares](interrupt::prepare) the supervisor of the parameters; that of the defaults, and a fault, where they are refused.
    #[inline(never)]
    pub(super) fn prepare(&mut self) -> Option<Fault> {
        if interrupt::prepare(&self.parameters).is_ok() {
            return None;
        }
        self.parameters = defaults::parameters();
        let refused = interrupt::prepare(&self.parameters).is_err();
        Some(if refused { Fault::SelfTest } else { Fault::BadParameters })
    }

    /// For when the control interrupt does not run.
    pub(super) fn is_dead(&mut self, fault: Fault) {
        self.status.mode = Mode::Faulted;
        self.status.faults.latch(fault);
    }

    /// Serves the port for ever.
    pub async fn serve(mut self, Port { usart, rx, tx }: Port) {
        let (mut sending, mut receiving) = ([0; LONGEST], [0; LONGEST]);
        let mut config = usart::Config::default();
        config.baudrate = BAUD_RATE;
        config.eager_reads = Some(1);
        let port =
            BufferedUart::new(usart, rx, tx, &mut sending, &mut receiving, Interrupts, config);
        let Ok(mut port) = port else { return defmt::error!("no serial port") };
        embassy_stm32::interrupt::USART2.set_priority(Priority::P6);
        let (mut tx, mut rx) = port.split_ref();
        let mut session = Session::default();
        let mut bytes = [0; 64];
        loop {
            // An error of the line is a byte less: its frame is dropped, and the host waits in vain.
            if let Either::First(Ok(count)) =
                select(rx.read(&mut bytes), Timer::after_millis(TURN)).await
            {
                for byte in bytes.iter().take(count) {
                    if let Some(frame) = session.receive(*byte, &mut self) {
                        send(&mut tx, frame).await;
                    }
                }
            }
            if let Some(frame) = session.telemetry(&mut self) {
                send(&mut tx, frame).await;
            }
        }
    }
}

/// Sends a frame. Asks again by itself: a write of embassy-stm32 0.6 that finds too little room at the end of its ring waits for ever.
async fn send(tx: &mut BufferedUartTx<'_>, mut frame: &[u8]) {
    while !frame.is_empty() {
        match select(tx.write(frame), Timer::after_millis(TURN)).await {
            Either::First(Ok(count)) => frame = frame.get(count..).unwrap_or_default(),
            Either::First(Err(_)) => return,
            Either::Second(()) => {}
        }
    }
}

impl Link {
    /// Keeps what an answer tells of the drive.
    fn heed(&mut self, answer: Option<interrupt::Answer>) -> Result<(), Refusal<'static>> {
        let interrupt::Answer { result, status, progress } = answer.ok_or(Refusal::Busy)?;
        self.status = status;
        self.progress = progress;
        Ok(result?)
    }

    #[inline(never)]
    fn change(&mut self, change: Change, to: &Parameters) -> Result<(), Refusal<'static>> {
        interrupt::change(change, to)?;
        self.parameters = *to;
        Ok(())
    }
}

impl Device for Link {
    fn identity(&self) -> Identity<'static> {
        Identity {
            version: VERSION,
            board: "b-g431b-esc1",
            firmware: env!("CARGO_PKG_VERSION"),
            build: BUILD,
        }
    }

    /// As of the last command; each request is one.
    fn status(&self) -> Status {
        self.status
    }

    fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    fn command(&mut self, command: Command) -> Result<(), Refusal<'static>> {
        self.heed(interrupt::command(command))
    }

    fn change_controller(&mut self, control: &ControlConfig) -> Result<(), Refusal<'static>> {
        let drive = DriveConfig { control: *control, ..self.parameters.drive };
        self.change(Change::Controller, &Parameters { drive, ..self.parameters })
    }

    fn change_parameters(&mut self, parameters: &Parameters) -> Result<(), Refusal<'static>> {
        self.change(Change::Supervisor, parameters)
    }

    fn save_parameters(&mut self) -> Result<(), Refusal<'static>> {
        let saved = self.store.as_mut().map(|store| store.save(&self.parameters));
        if matches!(saved, Some(Ok(()))) { Ok(()) } else { Err(Refusal::NotSaved) }
    }

    fn commission(&mut self, nameplate: &Nameplate) -> Result<(), Refusal<'static>> {
        let commission = Commission::new(&nameplate.config(&self.parameters.drive)?)?;
        self.heed(interrupt::commission(commission))
    }

    /// As of the last command.
    fn progress(&self) -> Progress {
        self.progress
    }

    fn evidence(&mut self) -> Option<Evidence> {
        interrupt::evidence()
    }

    fn set_telemetry(&mut self, decimation: u32) {
        interrupt::set_telemetry(decimation);
    }

    fn next_telemetry(&mut self) -> Option<Telemetry> {
        interrupt::telemetry()
    }
}
