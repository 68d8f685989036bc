//! Boots an image without a motor, and prints what its interrupts cost: `cargo run --release -p virtual-board --example boot -- FILE [SECONDS]`.

use std::error::Error;
use std::process::ExitCode;
use std::time::Instant;
use virtual_board::world::{AnaloguePin, Gates, InputPin};
use virtual_board::{Image, VirtualBoard, World};

/// Exception number of the control interrupt, ADC1_2.
const CONTROL: u16 = 18 + 16;

/// A board at rest: 24 V, 25 °C, no motor.
struct Bench;

impl World for Bench {
    fn switch(&mut self, _time: f64, _gates: Gates) {}

    fn voltage(&mut self, _time: f64, pin: AnaloguePin) -> f64 {
        match pin {
            AnaloguePin::ShuntU | AnaloguePin::ShuntV | AnaloguePin::ShuntW => 0.128_6,
            AnaloguePin::BusVoltage => 24.0 * 18.0 / 187.0,
            AnaloguePin::Temperature => 3.3 * 4.7 / 14.7,
            AnaloguePin::Potentiometer => 0.0,
        }
    }

    fn encoder_edges(&mut self, _time: f64) -> i64 {
        0
    }

    fn level(&mut self, _time: f64, pin: InputPin) -> bool {
        match pin {
            InputPin::Button => true,
        }
    }
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let file = arguments.next().ok_or("which ELF file?")?;
    let duration: f64 = arguments.next().map_or(Ok(1.0), |text| text.parse())?;
    let image = Image::from_elf(&std::fs::read(file)?)?;
    let mut board = VirtualBoard::new(&image, Bench);
    let boot = 0.3;
    if let Err(stop) = board.run_until(boot) {
        let (_, function) = board.place();
        return Err(format!("{stop}, in {}", function.unwrap_or("no function")).into());
    }
    if let [_, reset, ..] = board.resets() {
        return Err(format!("it does not come up: {reset:x?}").into());
    }
    println!("violations: {:?}", board.violations());
    board.statistics().clear();
    let (start, before) = (Instant::now(), board.instructions());
    board.run_until(boot + duration)?;
    let wall = start.elapsed().as_secs_f64();
    let instructions = (board.instructions() - before) as f64;
    println!(
        "{:.3} s of wall time a simulated second, {:.1} million instructions a simulated second",
        wall / duration,
        instructions / duration / 1e6
    );
    println!("stack: {} bytes; main output {}", board.stack_use(), board.main_output());
    for (exception, handler) in board.statistics().handlers() {
        println!(
            "exception {exception}: {:.1} Hz, instructions {} to {}, mean {:.1}; cycles {} to {}, mean {:.1}",
            handler.count as f64 / duration,
            handler.instructions.min,
            handler.instructions.max,
            handler.instructions.mean(),
            handler.cycles.min,
            handler.cycles.max,
            handler.cycles.mean(),
        );
    }
    profile(&mut board, &image)?;
    Ok(())
}

/// Prints where the control interrupt's instructions are.
fn profile(board: &mut VirtualBoard<Bench>, image: &Image) -> Result<(), Box<dyn Error>> {
    board.statistics().clear();
    board.statistics().profiled = Some(CONTROL);
    board.run_until(board.time() + 0.2)?;
    let Some(handler) = board.statistics().handlers().get(&CONTROL) else { return Ok(()) };
    let mut functions = std::collections::BTreeMap::<&str, u64>::new();
    for (address, count) in &handler.addresses {
        let name = image.function_at(*address).map_or("?", |function| &function.name);
        *functions.entry(name).or_default() += count;
    }
    let mut functions: Vec<_> = functions.into_iter().collect();
    functions.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    println!("instructions of the control interrupt a period, by function:");
    for (name, count) in functions {
        println!("{:9.1}  {name}", count as f64 / handler.count as f64);
    }
    Ok(())
}
