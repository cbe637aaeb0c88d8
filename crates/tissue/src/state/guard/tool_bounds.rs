//! Checks what tools have done at the end of a step: the part of the guard for tools.
//!
//! The sums in which the guard detects a faulty point are those of sweeps. Tools move points after the last
//! sweep of a step, which these sums show one step later; a snapshot in between would contain it. So the few
//! points under tools are checked directly, and so are the tools' own numbers: at the end of each step that the
//! guard lets pass, everything in a snapshot is finite.

use glam::DVec3;

use crate::body::model::Model;
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::saved::LARGEST;
use crate::tools::contact::{Contacts, Tool};
use crate::tools::prescribed::Prescribed;
use palpate_haptics::ContactState;

fn is_sound(tool: &Tool) -> bool {
    let Tool { from_m, to_m, normal, offset_m, gap_m, force_n, steady_n, velocity_m_per_s, .. } = tool;
    let vectors = [from_m, to_m, normal, offset_m, gap_m, force_n, steady_n, velocity_m_per_s];
    // NaN is not below the bound.
    vectors.into_iter().all(|v: &DVec3| v.to_array().into_iter().all(|part| part.abs() < LARGEST))
}

/// Returns the place in memory of a point that a tool has moved by `farthest` spacings or more, or of a point under a
/// tool whose own numbers are not finite. `None` if all is well.
pub(crate) fn broken_by_tools<T: Real>(
    model: &Model,
    layout: &Layout,
    state: &State<T>,
    prescribed: &Prescribed,
    contacts: &Contacts,
    farthest: f64,
) -> Option<usize> {
    let is_good = |index: &usize| {
        (0..3).all(|c| {
            let at = c * layout.plane + layout.offset(*index);
            [state.u[at], state.d[at]].into_iter().all(|value| value.wide().abs() < farthest)
        })
    };
    let of_tool = |tool: &Tool| -> Option<usize> {
        let mut points = tool.moved_points().map(|point| model.index_of(point));
        if !is_sound(tool) {
            return Some(points.next().unwrap_or(0));
        }
        if tool.contact_state == ContactState::Free { None } else { points.find(|index| !is_good(index)) }
    };
    let grasped = prescribed.grasped().map(|(index, _)| index).find(|index| !is_good(index));
    let of_tools = || contacts.tools.iter().find_map(of_tool);
    grasped.or_else(of_tools).or_else(|| contacts.ties.broken_point(model, |index| is_good(&index)))
}
