//! Variations of the paper's scenario that several test files play.

use host_sim::scenario::{Controller, FormName, Scenario};

/// The paper's cycle at 20 kHz with one period of delay.
pub fn at_20_khz(controller: Controller) -> Scenario {
    let mut scenario = Scenario::paper();
    scenario.control.controller = controller;
    scenario
}

/// The paper's cycle at 20 kHz in one form, with or without the delay.
#[allow(dead_code, reason = "not every test file that shares this module uses it")]
pub fn in_form(form: FormName, delay: bool) -> Scenario {
    let mut scenario = at_20_khz(Controller::BsQsmdo);
    scenario.control.form = form;
    scenario.timing.delay = delay;
    scenario
}
