//! Commands that are shown, run in the repository's root, and must succeed.

use anyhow::{Context, Result, bail};
use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::Mutex;
use std::thread;

/// The repository's root.
pub fn root() -> &'static Path {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.parent().unwrap_or(here)
}

/// A command to run.
pub struct Shell(Command);

/// Any program.
pub fn program(name: impl AsRef<OsStr>) -> Shell {
    let mut command = Command::new(name);
    command.current_dir(root());
    Shell(command)
}

/// The cargo that runs this.
pub fn cargo(arguments: &[&str]) -> Shell {
    program(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into())).args(arguments)
}

impl Shell {
    pub fn args<A: AsRef<OsStr>>(mut self, arguments: &[A]) -> Self {
        self.0.args(arguments);
        self
    }

    pub fn env(mut self, name: &str, value: impl AsRef<OsStr>) -> Self {
        self.0.env(name, value);
        self
    }

    pub fn env_remove(mut self, name: &str) -> Self {
        self.0.env_remove(name);
        self
    }

    pub fn current_dir(mut self, folder: &Path) -> Self {
        self.0.current_dir(folder);
        self
    }

    /// Without the command's standard output.
    pub fn silent(mut self) -> Self {
        self.0.stdout(Stdio::null());
        self
    }

    fn text(&self) -> String {
        let program = Path::new(self.0.get_program());
        let name = program.file_name().unwrap_or(program.as_os_str());
        let words = std::iter::once(name).chain(self.0.get_args());
        words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ")
    }

    /// Shows the command, runs it, and fails if it does.
    pub fn run(self) -> Result<()> {
        self.shown(|command| command.status(), |status| *status).map(drop)
    }

    /// The same, and gives what it prints.
    pub fn read(mut self) -> Result<String> {
        self.0.stderr(Stdio::inherit());
        let output = self.shown(|command| command.output(), |output| output.status)?;
        Ok(String::from_utf8(output.stdout)?)
    }

    fn shown<T>(
        mut self,
        run: impl FnOnce(&mut Command) -> io::Result<T>,
        status: impl FnOnce(&T) -> ExitStatus,
    ) -> Result<T> {
        let text = self.text();
        eprintln!("==> {text}");
        let result = run(&mut self.0).with_context(|| format!("cannot run `{text}`"))?;
        let status = status(&result);
        if !status.success() {
            bail!("`{text}` failed: {status}");
        }
        Ok(result)
    }

    /// What the command prints, if it can be run and succeeds.
    pub fn output(mut self) -> Option<String> {
        let output = self.0.stderr(Stdio::null()).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

/// Runs all, as many at once as there are processors, and prints what each printed when it has ended. Fails if one does.
pub fn run_all(commands: Vec<Shell>) -> Result<()> {
    let left = Mutex::new(commands.into_iter());
    let take = || left.lock().ok()?.next();
    let work = || -> Result<()> {
        while let Some(command) = take() {
            print!("{}", command.read()?);
        }
        Ok(())
    };
    let count = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        let workers: Vec<_> = (0..count).map(|_| scope.spawn(work)).collect();
        workers.into_iter().try_for_each(|worker| joined(worker.join()))
    })
}

/// What a thread gave.
pub fn joined<T>(result: thread::Result<Result<T>>) -> Result<T> {
    result.unwrap_or_else(|_| bail!("a thread panicked"))
}

/// Where a program is on the PATH.
pub fn find(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|folder| folder.join(name)).find(|file| file.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_are_run_and_one_that_fails_is_told() {
        let folder = root().join("target/run_all");
        let touch = |name: &str| program("mkdir").args(&["-p"]).args(&[folder.join(name)]);
        run_all((0..5).map(|number| touch(&number.to_string())).collect()).expect("none fails");
        assert_eq!(std::fs::read_dir(&folder).expect("made").count(), 5);
        std::fs::remove_dir_all(&folder).expect("removed");
        let error = run_all(vec![program("true"), program("false"), program("true")]);
        assert!(error.expect_err("one fails").to_string().starts_with("`false` failed"));
    }
}
