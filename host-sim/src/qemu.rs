//! The drive in QEMU: processor in the loop.
//!
//! Starts `qemu-system-arm` with the firmware's image, its serial port connected to a local socket, and speaks
//! [`quasidrive::protocol`] with it. The process ends with the value.

use quasidrive::drive::DriveConfig;
use quasidrive::hal::Sample;
use quasidrive::protocol::{
    MAGIC, Question, RECORD_WORDS, Reply, Setup, VERSION, Verdict, Word, codes_to_words,
    exact_to_words,
};
use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

/// How long QEMU may take to start, and then to answer, if nothing else is said. A period takes it half a millisecond.
pub const PATIENCE: Duration = Duration::from_secs(10);

const SETTING_UP: &str = "while setting up";
const RUNNING: &str = "while running";

/// Why QEMU did not do as a drive.
#[derive(Debug, thiserror::Error)]
pub enum QemuError {
    /// There is no firmware to run.
    #[error("no firmware image at {}: build it by `cargo xtask firmware`", .0.display())]
    NoImage(PathBuf),
    /// The log cannot be written.
    #[error("cannot write the firmware's log: {0}")]
    NoLog(std::io::Error),
    /// QEMU is not installed, or does not start.
    #[error("cannot start qemu-system-arm: {0}; `cargo xtask setup` installs it")]
    NoQemu(std::io::Error),
    /// QEMU ended by itself.
    #[error("QEMU ended by itself ({status}): {message}")]
    Ended {
        /// Its exit status.
        status: String,
        /// What it said.
        message: String,
    },
    /// No answer in time.
    #[error("no answer from QEMU within {waited:?}, {when}")]
    Late {
        /// How long was waited.
        waited: Duration,
        /// For what.
        when: &'static str,
    },
    /// Somebody wants the run to end.
    #[error("interrupted")]
    Interrupted,
    /// The connection broke.
    #[error("lost QEMU {when}: {error}")]
    Lost {
        /// How it showed.
        error: std::io::Error,
        /// During what.
        when: &'static str,
    },
    /// What answers does not speak the protocol.
    #[error("QEMU's firmware does not answer as a drive ({0:#010x})")]
    NotADrive(u32),
    /// The firmware speaks another version.
    #[error(
        "QEMU's firmware speaks protocol {0}, this host {VERSION}: rebuild it by `cargo xtask firmware`"
    )]
    WrongVersion(u32),
    /// The firmware computes in another scalar.
    #[error(
        "QEMU's firmware computes in {there}, this host in {here}: not the image for this machine"
    )]
    WrongScalar {
        /// The firmware's.
        there: String,
        /// The host's.
        here: String,
    },
    /// The firmware refused the configuration.
    #[error("QEMU's firmware refused the drive's configuration")]
    SetupRefused,
}

/// What to start.
#[derive(Clone, Copy, Debug)]
pub struct Emulator<'a> {
    /// `qemu-system-arm`.
    pub program: &'a Path,
    /// Arguments beyond those that it takes to play a drive.
    pub arguments: &'a [String],
    /// Its machine.
    pub machine: &'a str,
    /// The firmware's ELF.
    pub image: &'a Path,
    /// File for the firmware's log, in defmt's encoding.
    pub log: Option<&'a Path>,
    /// How long QEMU may take to start, and then to answer.
    pub patience: Duration,
    /// Ends the waiting when it becomes true.
    pub interrupted: &'a AtomicBool,
}

/// A running QEMU whose firmware is a drive.
pub struct Qemu<'a> {
    process: Process,
    stream: UnixStream,
    patience: Duration,
    interrupted: &'a AtomicBool,
}

/// A child process that is killed when dropped.
struct Process {
    child: Child,
    /// Holds its socket and its messages.
    folder: Folder,
}

impl Drop for Process {
    fn drop(&mut self) {
        // Either fails only if the process is gone already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl<'a> Qemu<'a> {
    /// Starts QEMU and makes it the drive of `config`, which computes in `S`.
    pub fn start<S: Word>(
        emulator: &Emulator<'a>,
        config: &DriveConfig,
    ) -> Result<Self, QemuError> {
        let &Emulator { program, machine, image, .. } = emulator;
        if !image.is_file() {
            return Err(QemuError::NoImage(image.to_owned()));
        }
        let log = match emulator.log {
            Some(file) => File::create(file).map_err(QemuError::NoLog)?.into(),
            None => Stdio::null(),
        };
        let folder = Folder::new().map_err(QemuError::NoQemu)?;
        let messages = File::create(folder.messages()).map_err(QemuError::NoQemu)?;
        let socket = folder.0.join("serial");
        let listener = UnixListener::bind(&socket).map_err(QemuError::NoQemu)?;
        let child = Command::new(program)
            .args(["-machine", machine, "-display", "none", "-monitor", "none"])
            // The firmware logs by semihosting, which ends at QEMU's standard output.
            .args(["-semihosting-config", "enable=on,target=native"])
            // One thread: waking a second one for every byte takes twice as long.
            .args(["-accel", "tcg,thread=single"])
            .args(["-chardev", &format!("socket,id=serial,path={}", socket.display())])
            .args(["-serial", "chardev:serial"])
            .args(emulator.arguments)
            .arg("-kernel")
            .arg(image)
            .stdin(Stdio::null())
            .stdout(log)
            .stderr(messages)
            .spawn()
            .map_err(QemuError::NoQemu)?;
        let mut process = Process { child, folder };
        let stream = accept(&listener, &mut process, emulator)?;
        Self::on::<S>(stream, process, emulator, config)
    }

    /// Makes whoever is at the other end of `stream` the drive of `config`.
    fn on<S: Word>(
        stream: UnixStream,
        process: Process,
        &Emulator { patience, interrupted, .. }: &Emulator<'a>,
        config: &DriveConfig,
    ) -> Result<Self, QemuError> {
        stream.set_nonblocking(true).map_err(QemuError::NoQemu)?;
        let mut qemu = Self { process, stream, patience, interrupted };
        qemu.set_up::<S>(config)?;
        Ok(qemu)
    }

    fn set_up<S: Word>(&mut self, config: &DriveConfig) -> Result<(), QemuError> {
        self.send(&[MAGIC, VERSION], SETTING_UP)?;
        let setup = Setup(*config).to_words().ok_or(QemuError::SetupRefused)?;
        self.send(&setup, SETTING_UP)?;
        let [magic, version, verdict, scalar] = self.receive(SETTING_UP)?;
        if magic != MAGIC {
            return Err(QemuError::NotADrive(magic));
        }
        if version != VERSION {
            return Err(QemuError::WrongVersion(version));
        }
        if scalar != S::NAME {
            let [there, here] = [scalar, S::NAME]
                .map(|name| String::from_utf8_lossy(&name.to_le_bytes()).trim().to_owned());
            return Err(QemuError::WrongScalar { there, here });
        }
        match Verdict::from_word(verdict) {
            Some(Verdict::Accepted) => Ok(()),
            Some(Verdict::WrongVersion) => Err(QemuError::WrongVersion(version)),
            Some(Verdict::Refused) => Err(QemuError::SetupRefused),
            None => Err(QemuError::NotADrive(verdict)),
        }
    }

    /// One period, with a new commanded speed (rad/s) if there is one.
    pub fn period<S: Word>(
        &mut self,
        target: Option<f32>,
        sample: &Sample<S>,
    ) -> Result<Reply, QemuError> {
        let question = match target {
            Some(_) => Question::TargetAndSample,
            None => Question::Sample,
        };
        let mut words: Vec<u32> = target.map(f32::to_bits).into_iter().collect();
        match sample {
            Sample::Exact(exact) => words.extend(exact_to_words(exact)),
            Sample::Codes(codes) => words.extend(codes_to_words(codes)),
        }
        self.ask(question, &words, RUNNING)?;
        Ok(Reply::from_words(self.receive(RUNNING)?))
    }

    /// The words of the last period's [`Record`](quasidrive::protocol::Record).
    pub fn record(&mut self) -> Result<[u32; RECORD_WORDS], QemuError> {
        self.ask(Question::Record, &[], RUNNING)?;
        self.receive(RUNNING)
    }

    fn ask(
        &mut self,
        question: Question,
        words: &[u32],
        when: &'static str,
    ) -> Result<(), QemuError> {
        let words = words.iter().flat_map(|word| word.to_le_bytes());
        self.send_bytes(&std::iter::once(question as u8).chain(words).collect::<Vec<u8>>(), when)
    }

    fn send(&mut self, words: &[u32], when: &'static str) -> Result<(), QemuError> {
        self.send_bytes(
            &words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>(),
            when,
        )
    }

    fn send_bytes(&mut self, bytes: &[u8], when: &'static str) -> Result<(), QemuError> {
        self.stream.write_all(bytes).map_err(|error| self.failure(error, when))
    }

    fn receive<const N: usize>(&mut self, when: &'static str) -> Result<[u32; N], QemuError> {
        let mut bytes = [[0; 4]; N];
        self.read_exact(bytes.as_flattened_mut()).map_err(|error| self.failure(error, when))?;
        Ok(bytes.map(u32::from_le_bytes))
    }

    /// Waits awake: put to sleep for every byte, this side and QEMU would take five times as long between them. But whoever else has something to do
    /// has it done meanwhile, another QEMU for one.
    fn read_exact(&mut self, mut rest: &mut [u8]) -> std::io::Result<()> {
        let start = Instant::now();
        while !rest.is_empty() {
            match self.stream.read(rest) {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Ok(count) => rest = &mut rest[count..],
                Err(error) if error.kind() != ErrorKind::WouldBlock => return Err(error),
                Err(error) if start.elapsed() > self.patience => return Err(error),
                Err(_) if self.interrupted.load(Relaxed) => return Err(interrupted()),
                Err(_) => std::thread::yield_now(),
            }
        }
        Ok(())
    }

    /// What a failed read or write means.
    fn failure(&mut self, error: std::io::Error, when: &'static str) -> QemuError {
        if error.kind() == ErrorKind::Interrupted {
            return QemuError::Interrupted;
        }
        if error.kind() == ErrorKind::WouldBlock {
            return QemuError::Late { waited: self.patience, when };
        }
        // A closed socket: give the process a moment to be seen as ended.
        std::thread::sleep(Duration::from_millis(100));
        ended(&mut self.process).unwrap_or(QemuError::Lost { error, when })
    }
}

/// Waits for QEMU to connect.
fn accept(
    listener: &UnixListener,
    process: &mut Process,
    &Emulator { patience, interrupted, .. }: &Emulator,
) -> Result<UnixStream, QemuError> {
    listener.set_nonblocking(true).map_err(QemuError::NoQemu)?;
    let start = Instant::now();
    while start.elapsed() < patience {
        match listener.accept() {
            Ok((stream, _)) => return Ok(stream),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(QemuError::NoQemu(error)),
        }
        if let Some(ended) = ended(process) {
            return Err(ended);
        }
        if interrupted.load(Relaxed) {
            return Err(QemuError::Interrupted);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Err(QemuError::Late { waited: patience, when: "to connect" })
}

fn interrupted() -> std::io::Error {
    ErrorKind::Interrupted.into()
}

/// The error of a process that has ended, with what it said.
fn ended(process: &mut Process) -> Option<QemuError> {
    let status = process.child.try_wait().ok()??;
    // A message that cannot be read is no message.
    let message = std::fs::read_to_string(process.folder.messages()).unwrap_or_default();
    Some(QemuError::Ended { status: status.to_string(), message: message.trim().to_owned() })
}

/// A folder of one's own, removed when dropped.
struct Folder(PathBuf);

impl Folder {
    fn new() -> std::io::Result<Self> {
        use std::sync::atomic::AtomicU64;
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let count = COUNT.fetch_add(1, Relaxed);
        let name = format!("quasidrive-{}-{count}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir(&folder)?;
        Ok(Self(folder))
    }

    /// Where a process's messages go: to a file, for a pipe that nobody reads would stop it when full.
    fn messages(&self) -> PathBuf {
        self.0.join("messages")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What cannot be removed is left to the system's cleaning.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::scenario::Scenario;
    use quasidrive::drive::Mode;
    use quasidrive::hal::BridgeCommand;
    use quasidrive::math::Q31;
    use quasidrive::protocol::Record;

    const SAMPLE: Sample<f32> = Sample::Exact(quasidrive::hal::Exact {
        speed: 1.0,
        advance: 5e-5,
        current: 2.0,
        bus_voltage: 24.0,
    });

    static NEVER: AtomicBool = AtomicBool::new(false);

    fn emulator<'a>(
        program: &'a str,
        image: &'a Path,
        interrupted: &'a AtomicBool,
    ) -> Emulator<'a> {
        Emulator {
            program: Path::new(program),
            arguments: &[],
            log: None,
            machine: "mps2-an386",
            image,
            patience: Duration::from_secs(1),
            interrupted,
        }
    }

    fn sleeper() -> Process {
        let child = Command::new("sleep").arg("60").spawn().expect("sleep");
        Process { child, folder: Folder::new().expect("a folder") }
    }

    /// A connection to a thread that answers with `words`, one message after the other, and then hangs up, or stays
    /// silent where `stays` says so.
    pub(crate) fn against(answers: Vec<Vec<u32>>, stays: bool) -> Result<Qemu<'static>, QemuError> {
        let (here, mut there) = UnixStream::pair().expect("a socket pair");
        std::thread::spawn(move || {
            for (number, words) in answers.iter().enumerate() {
                let question = if number == 0 { 4 * (2 + Setup::WORDS) } else { 1 };
                let _ = there.read_exact(&mut vec![0; question]);
                let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
                let _ = there.write_all(&bytes);
            }
            if stays {
                std::thread::sleep(Duration::from_secs(2));
            }
        });
        let config = Scenario::paper().drive_config();
        Qemu::on::<f32>(here, sleeper(), &emulator("none", Path::new("none"), &NEVER), &config)
    }

    pub(crate) fn accepted() -> Vec<u32> {
        vec![MAGIC, VERSION, Verdict::Accepted as u32, f32::NAME]
    }

    #[test]
    fn a_drive_that_answers_is_used() {
        let command = BridgeCommand::Duty(0.5);
        let record = Record { command, mode: Mode::Running, telemetry: None };
        let answers =
            vec![accepted(), record.reply().to_words().to_vec(), record.to_words().to_vec()];
        let mut qemu = against(answers, true).expect("set up");
        assert_eq!(qemu.period(Some(1.0), &SAMPLE).expect("a reply"), record.reply());
        assert_eq!(qemu.record().expect("a record"), record.to_words());
    }

    #[test]
    fn set_up_errors_are_told_apart() {
        let error = |words: Vec<u32>| against(vec![words], true).err().expect("refused");
        let other = VERSION + 1;
        let answer = |magic, version, verdict| vec![magic, version, verdict, f32::NAME];
        assert!(matches!(error(answer(7, VERSION, 0)), QemuError::NotADrive(7)));
        let refused = error(answer(MAGIC, other, 1));
        assert!(matches!(refused, QemuError::WrongVersion(version) if version == other));
        assert!(matches!(error(answer(MAGIC, VERSION, 2)), QemuError::SetupRefused));
        assert!(matches!(error(answer(MAGIC, VERSION, 9)), QemuError::NotADrive(9)));
        assert_eq!(
            error(vec![MAGIC, VERSION, 0, Q31::NAME]).to_string(),
            "QEMU's firmware computes in q31, this host in f32: not the image for this machine"
        );
        assert!(matches!(error(vec![MAGIC]), QemuError::Late { .. }), "a short read");
    }

    #[test]
    fn a_lost_or_late_drive_is_an_error() {
        let period = |answers, stays| {
            let mut qemu = against(answers, stays).expect("set up");
            qemu.period(None, &SAMPLE).expect_err("no reply")
        };
        assert!(matches!(period(vec![accepted()], true), QemuError::Late { .. }));
        let short = period(vec![accepted(), vec![1, 2]], false);
        assert!(matches!(short, QemuError::Lost { .. }), "{short}");
    }

    #[test]
    fn a_process_that_is_none_ends_or_never_connects_is_an_error() {
        let image = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        let start = |program: &str, image: &Path| {
            let emulator = emulator(program, image, &NEVER);
            Qemu::start::<f32>(&emulator, &Scenario::paper().drive_config())
                .err()
                .expect("no drive")
        };
        assert!(matches!(start("no-such-qemu", &image), QemuError::NoQemu(_)));
        assert!(matches!(start("false", &image), QemuError::Ended { .. }));
        assert!(matches!(start("yes", &image), QemuError::Ended { .. } | QemuError::Late { .. }));
        assert!(matches!(start("false", Path::new("no.elf")), QemuError::NoImage(_)));
    }

    #[test]
    fn an_interruption_ends_the_waiting() {
        let image = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        let interrupted = AtomicBool::new(true);
        let emulator = Emulator {
            patience: Duration::from_secs(60),
            ..emulator("sleep", &image, &interrupted)
        };
        // `sleep` does not know QEMU's options and ends; a program that stayed would be interrupted.
        let error =
            Qemu::start::<f32>(&emulator, &Scenario::paper().drive_config()).err().expect("none");
        assert!(matches!(error, QemuError::Interrupted | QemuError::Ended { .. }), "{error}");
        let mut qemu = against(vec![accepted()], true).expect("set up");
        qemu.interrupted = &interrupted;
        qemu.patience = Duration::from_secs(60);
        let error = qemu.period(None, &SAMPLE).expect_err("interrupted");
        assert!(matches!(error, QemuError::Interrupted), "{error}");
    }

    #[test]
    fn no_process_is_left_behind() {
        let process = sleeper();
        let (id, folder) = (process.child.id(), process.folder.0.clone());
        assert!(Path::new(&format!("/proc/{id}")).exists());
        drop(process);
        assert!(!Path::new(&format!("/proc/{id}")).exists());
        assert!(!folder.exists());
    }
}
