use virtual_board::{Image, VirtualBoard, World};
use virtual_board::world::*;
struct Bench;
impl World for Bench {
    fn switch(&mut self, _time: f64, _gates: Gates) {}
    fn voltage(&mut self, _time: f64, pin: AnaloguePin) -> f64 { match pin { AnaloguePin::BusVoltage => 2.31, AnaloguePin::Temperature => 1.055, AnaloguePin::Potentiometer => 0.0, _ => 0.1286 } }
    fn encoder_edges(&mut self, _time: f64) -> i64 { 0 }
    fn level(&mut self, _time: f64, _pin: InputPin) -> bool { true }
}
fn main() {
    let image = Image::from_elf(&std::fs::read(std::env::args().nth(1).unwrap()).unwrap()).unwrap();
    let from: f64 = std::env::args().nth(2).unwrap().parse().unwrap();
    let step: f64 = std::env::args().nth(3).unwrap().parse().unwrap();
    let n: u32 = std::env::args().nth(4).unwrap().parse().unwrap();
    let mut b = VirtualBoard::new(&image, Bench);
    let mut t = from;
    for _ in 0..n { if let Err(e) = b.run_until(t) { println!("{e}"); return; } println!("{:.7} {:x?} sp {:x} locked {}", b.time(), b.place(), b.stack_pointer(), b.is_locked_up()); t += step; if b.is_locked_up() { println!("{:?}", b.fault_address()); return } }
}
