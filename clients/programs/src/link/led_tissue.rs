//! A tissue with instruments that hands lead, as on a server.

use std::sync::Arc;

use palpate_haptics::{Instrument, InstrumentPose, OtherInstrument};
use palpate_session::command::Command;
use palpate_session::led_instrument::{InstrumentSample, LedInstrument};
use palpate_session::simulation::Simulation;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Action;

use super::setup::TICK_S;
use super::tissue::{LEASE, ns};

/// A tissue with equal instruments, each with a lease of its own.
pub(super) struct LedTissue {
    simulation: Simulation,
    led: Vec<LedInstrument>,
    /// Whether poses may overtake each other.
    pub(super) by_datagram: bool,
}

impl LedTissue {
    /// Creates a tissue at rest with `count` instruments, whose tips are tools one after another.
    ///
    /// # Errors
    /// Returns why the intake refuses their tools.
    pub(super) fn new(model: &Arc<Model>, instrument: &Instrument, count: u32) -> Result<Self, String> {
        let (limits, tips) = (Limits::default(), tips(instrument));
        let mut simulation = Simulation::new(model, &limits);
        let mut led = Vec::new();
        for which in 0..count {
            let first_tool = which * tips;
            let tools: Vec<u32> = (first_tool..first_tool + tips).collect();
            let lease = LEASE + u128::from(which);
            let acquired = simulation.intake.acquire(&tools, "palpate-client link", limits.lease_s, lease, 0);
            acquired.map_err(|refusal| refusal.to_string())?;
            led.push(LedInstrument::new(instrument.clone(), first_tool));
        }
        Ok(LedTissue { simulation, led, by_datagram: false })
    }

    /// Returns the number of steps done.
    pub(super) fn step_count(&self) -> u64 {
        self.simulation.session.step_count()
    }

    /// Returns the number of springs or faces that blades have severed.
    pub(super) fn severed(&self) -> u64 {
        self.simulation.session.tissue().cuts().len() as u64
    }

    /// Leads an instrument to a pose by the command with a number; it is played by the client's time, ns, if that is not 0.
    ///
    /// # Errors
    /// Returns why the intake refuses the commands.
    pub(super) fn lead(
        &mut self,
        which: usize,
        number: u64,
        pose: &InstrumentPose,
        client_time_ns: u64,
        now_s: f64,
    ) -> Result<(), String> {
        let led = &mut self.led[which];
        let by_datagram = self.by_datagram && client_time_ns != 0;
        let command = Command::new(led.first_tool(), Some(number), Action::Release);
        let command = Command { client_time_ns, by_datagram, ..command };
        let commands = led.lead(&command, pose, None, self.simulation.session.model().shape());
        let is_far = commands.iter().all(|command| command.action == Action::Release);
        let lease = LEASE + which as u128;
        self.simulation.intake.submit(lease, commands, ns(now_s)).map_err(|refusal| refusal.to_string())?;
        led.accepted(&command, *pose, None, is_far);
        Ok(())
    }

    /// Does the steps of the tick that begins at `now_s`. Returns for each instrument what it feels after them, and where it is.
    ///
    /// # Errors
    /// Returns the reason if the guard stops the tissue.
    pub(super) fn step(&mut self, now_s: f64) -> Result<Vec<Option<(InstrumentSample, OtherInstrument)>>, String> {
        // Rounding must not add a step.
        while self.simulation.session.time_s() < now_s + TICK_S - 1e-9 {
            let begin_s = self.simulation.session.time_s();
            self.simulation.step(ns(begin_s)).map_err(|refusal| refusal.to_string())?;
            if let Some(reason) = self.simulation.session.fault() {
                return Err(reason);
            }
        }
        let sample = self.simulation.session.sample(None);
        self.led.iter_mut().for_each(|led| led.see(&sample));
        let seen: Vec<_> = self.led.iter().map(|led| led.seen(sample.simulation_time_s)).collect();
        let others = || seen.iter().flatten().copied();
        let felt = self.led.iter_mut().zip(&seen).map(|(led, seen)| led.sample(&sample, others()).zip(*seen));
        Ok(felt.collect())
    }
}

/// Returns the number of tips of an instrument.
pub(super) fn tips(instrument: &Instrument) -> u32 {
    u32::try_from(instrument.tips.len()).unwrap_or(u32::MAX)
}
