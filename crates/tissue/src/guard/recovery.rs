//! Recovery: how a tissue continues after a blow-up that the guard could not repair.
//!
//! The guard leaves the tissue in the state of its last checkpoint, with the last substep that it tried. A
//! recovery keeps that state, restores the model's own substep and releases all tools. Time does not go back:
//! the tissue continues at the step at which the blow-up was found. Only displacements and velocities are kept;
//! the scheme's history begins anew, as after a change of tissue (`change`). So the result depends on the
//! checkpoint alone.
//!
//! A checkpoint just after a change of tissue or a recovery has passed no check: the fault may be in that very
//! state. Then the tissue continues at rest, which is safe for any tissue.

use crate::guard::checkpoint::Input;
use crate::interface::Released;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;
use crate::tools::contact::Contacts;
use crate::tools::prescribed::Prescribed;

impl<T: Real> TissueState<T> {
    /// Continues at step `step` from the state of the checkpoint, in which a blow-up has left the tissue.
    /// Continues at rest if `to_rest` or if that state has passed no check.
    pub(crate) fn recover(&mut self, step: u64, to_rest: bool) -> Released {
        let at_rest = to_rest || self.checkpoint.as_ref().is_some_and(|checkpoint| !checkpoint.passed_checks);
        let pushing = self.applied.slots.iter().enumerate().filter(|(_, slot)| slot.push.is_some());
        let mut tools: Vec<usize> =
            pushing.map(|(tool, _)| tool).chain(self.prescribed.tools()).chain(self.contacts.tools()).collect();
        tools.sort_unstable();
        tools.dedup();
        if at_rest {
            // Also discards what the end of a force or a grasp would add to the next substep.
            self.state = State::at_rest(&self.tables.layout, self.state.kept.len());
            (self.applied, self.prescribed, self.contacts) = (Applied::new(), Prescribed::new(), Contacts::default());
        }
        // The largest displacement of the failed attempts must not decide what may sleep.
        if let Some(checkpoint) = &self.checkpoint {
            self.tiles.largest = checkpoint.largest;
        }
        let model = self.model.clone();
        self.tiles.begin_anew(model.tile_tolerance());
        self.audit_window.give_up();
        self.exchange(&model);
        self.steps = step;
        self.begin_account();
        for tool in &tools {
            self.input(*tool, Input::Push(None));
        }
        Released { tools, at_rest }
    }
}
