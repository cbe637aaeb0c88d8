//! The rules for a command that do not depend on when it comes, so it can be checked without locking the intake.

use smallvec::SmallVec;

use super::command::Command;
use palpate_haptics::{Tip, TipShape};
use palpate_refusal::{Reason, Refusal, Result, legible, positive};
use palpate_tissue::limits::Limits;
use palpate_tissue::rigid_tip_work;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::action_check::{
    self, check_free, check_mark, check_poke, check_reach, check_tie, check_tie_number,
};
use palpate_tissue::scene::script::Action;
use palpate_tissue::shape::RestShape;

/// Rules for the commands of one session that do not depend on their time: its scene and its limits. They never
/// change.
#[derive(Debug)]
pub struct Rules {
    pub(super) scene: Scene,
    pub(super) limits: Limits,
}

/// Commands of one call. A single one, as in a stream at 1 kHz, takes no memory of its own.
pub type Commands = SmallVec<[Command; 1]>;

/// Commands that [`Rules::check`] has accepted, in their order, for
/// [`Intake::accept`](super::intake::Intake::accept).
#[derive(Debug)]
pub struct CheckedCommands(pub(super) Commands);

impl Rules {
    /// Creates the rules of a session that begins with `scene`, under `limits`.
    pub fn new(scene: &Scene, limits: &Limits) -> Self {
        Rules { scene: scene.clone(), limits: limits.clone() }
    }

    /// Returns the number of tools, `limits.tools`: each tool has a number below it.
    pub fn most_tools(&self) -> u32 {
        self.limits.tools
    }

    /// Checks all of `commands`, and returns them if each keeps to the rules. It does not check numbers of tools and
    /// sequence numbers: those belong to leases.
    ///
    /// # Errors
    /// Refuses more commands than one tool may have waiting, `limits.queued_commands_per_tool`
    /// ([`Reason::QueueFull`]), and the first command that [`Rules::check_one`] refuses.
    pub fn check(&self, commands: impl Into<Commands>) -> Result<CheckedCommands> {
        let commands = commands.into();
        if commands.len() > self.limits.queued_commands_per_tool {
            let message = format!("{} commands are more than a tool may have waiting", commands.len());
            return Err(Refusal::new(Reason::QueueFull, "", message));
        }
        commands.iter().try_for_each(|command| self.check_one(command))?;
        Ok(CheckedCommands(commands))
    }

    /// Checks one command: its time to live, its place on the tissue, its force or reach, and its tip. A grasped point
    /// must be one of the tissue; otherwise the check may panic.
    ///
    /// # Errors
    /// Refuses, naming the field:
    /// - a time to live that is not above 0, and a negative falloff;
    /// - numbers that are not finite;
    /// - a force whose size at its control point, |force|·e^{c′}, is above `limits.point_force_n`, or whose control point
    ///   is off the tissue by more than a tenth of its longest side;
    /// - a grasp of a fixed point;
    /// - a grasp moved farther from rest, or a pose farther from the tissue's middle, than `limits.reach_in_sides`
    ///   times its longest side;
    /// - a pose with a velocity that has no client time or has a step ([`Reason::Missing`]);
    /// - a tip that does not fit the tissue;
    /// - a thread or clip that does not fit it ([`check_tie`]), or a number of one above `limits.ties`;
    /// - a mark off the tissue ([`check_mark`]).
    pub fn check_one(&self, command: &Command) -> Result<()> {
        if let Some(seconds) = command.time_to_live_s {
            positive("time_to_live_s", seconds)?;
        }
        match &command.action {
            Action::Push(poke) => check_poke(poke, self.scene.shape(), &self.limits),
            Action::Grasp { point, displacement_m } => {
                check_free("position.point", self.scene.shape(), *point)?;
                // A client gives a displacement or a position.
                palpate_refusal::finite_vector("position", *displacement_m)?;
                let far_m = displacement_m.length();
                check_reach("position", self.scene.shape(), far_m, &self.limits)
            }
            Action::Pose { place_m, velocity_m_per_s, tip } => {
                palpate_refusal::finite_vector("pose.position_m", *place_m)?;
                if let Some(velocity_m_per_s) = velocity_m_per_s {
                    palpate_refusal::finite_vector("pose.velocity_m_per_s", *velocity_m_per_s)?;
                    check_played_by_time(command)?;
                }
                let centre_m = self.scene.shape().extent().middle_m();
                check_reach("pose.position_m", self.scene.shape(), (*place_m - centre_m).length(), &self.limits)?;
                action_check::check_tip("pose.tip", self.scene.shape(), tip)
            }
            Action::Tie { number, tie } => {
                check_tie_number("tie.number", *number, &self.limits)?;
                tie.as_ref().map_or(Ok(()), |tie| check_tie("tie", self.scene.shape(), tie, &self.limits))
            }
            Action::Mark(mark) => check_mark("mark", self.scene.shape(), mark),
            Action::Release => Ok(()),
        }
    }
}

/// Refuses a velocity with a pose that is not played by client time.
fn check_played_by_time(command: &Command) -> Result<()> {
    let message = "goes with a pose that is played by the client's time: give client_time_ns, and no at_step";
    let is_played = command.client_time_ns != 0 && command.at_step.is_none();
    if is_played { Ok(()) } else { Err(Refusal::new(Reason::Missing, "pose.velocity_m_per_s", message)) }
}

/// Returns how many triangles a tip makes a session look up in a step of `substeps` substeps: a disc of even pressure is laid out
/// twice in each ([`RestShape::disc_work`]). For a rigid tip it is the number that takes as long ([`rigid_tip_work`]).
fn contact_work(shape: &dyn RestShape, tip: LeasedTip, substeps: u32) -> u64 {
    let of_substep = if tip.shape.is_rigid() {
        rigid_tip_work(tip.radius_m, shape.edge_m())
    } else {
        shape.disc_work(tip.radius_m).saturating_mul(2)
    };
    of_substep.saturating_mul(u64::from(substeps))
}

/// Refuses a tip that would make a step too long for the other sessions of its thread. `tips` are the session's other tips.
pub(super) fn check_contact_work(
    rules: &Rules,
    substeps: u32,
    now: LeasedTip,
    tips: impl Iterator<Item = LeasedTip>,
) -> Result<()> {
    let shape = rules.scene.shape();
    let most = rules.limits.contact_work;
    let others = tips.fold(0_u64, |sum, tip| sum.saturating_add(contact_work(shape, tip, substeps)));
    let all = |radius_m: f64| others.saturating_add(contact_work(shape, LeasedTip { radius_m, ..now }, substeps));
    if all(now.radius_m) <= most {
        return Ok(());
    }
    // Halved until it fits: the work grows with the radius.
    let fits = std::iter::successors(Some(0.5 * now.radius_m), |radius_m| Some(0.5 * radius_m))
        .take(16)
        .find(|radius_m| all(*radius_m) <= most);
    let advice =
        fits.map_or("release other tools first".to_owned(), |radius_m| format!("{} m fits", legible(radius_m)));
    let message = format!(
        "is {} m: with it, a step would take as long as looking up {} triangles under the tips of this session, above {most} \
         (limits.contact_work); {advice}",
        legible(now.radius_m),
        all(now.radius_m)
    );
    Err(Refusal::new(Reason::TooLarge, "pose.tip.radius_m", message))
}

/// Returns whether a tool may sever springs by an action: with a blade or by heat.
pub(super) fn may_sever(action: &Action) -> bool {
    matches!(action, Action::Pose { tip, .. } if tip.shape == TipShape::Blade || tip.burn_s > 0.0)
}

/// What of a tip stays while a tool is led.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeasedTip {
    shape: TipShape,
    radius_m: f64,
}

impl From<Tip> for LeasedTip {
    fn from(Tip { shape, radius_m, .. }: Tip) -> Self {
        LeasedTip { shape, radius_m }
    }
}

/// Returns the tip that a tool has after a command, if it had the tip `before`; `None` if it has none.
pub(super) fn leased_tip(before: Option<LeasedTip>, command: &Command) -> Option<LeasedTip> {
    match &command.action {
        Action::Pose { tip, .. } => Some((*tip).into()),
        // The tool goes on.
        Action::Tie { .. } | Action::Mark(_) => before,
        Action::Push(_) | Action::Grasp { .. } | Action::Release => None,
    }
}

/// Refuses a change of the tip while it is in the tissue: the surface under a larger tip lies elsewhere, and
/// meeting it at once would be a blow that no instrument gives.
pub(super) fn check_tip(before: Option<LeasedTip>, now: Option<LeasedTip>) -> Result<()> {
    match (before, now) {
        (Some(before), Some(now)) if before.shape != now.shape => {
            let [before, now] = [before, now].map(|tip| tip.shape.name());
            let message = format!("is {now}, but the tool is led with a tip that is {before}: release it first");
            Err(Refusal::new(Reason::OutOfTurn, "pose.tip.shape", message))
        }
        (Some(before), Some(now)) if before.radius_m.to_bits() != now.radius_m.to_bits() => {
            let [before_m, now_m] = [before, now].map(|tip| legible(tip.radius_m));
            let message = format!("is {now_m} m, but the tool is led with a tip of {before_m} m: release it first");
            Err(Refusal::new(Reason::OutOfTurn, "pose.tip.radius_m", message))
        }
        _ => Ok(()),
    }
}
