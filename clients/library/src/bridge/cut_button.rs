//! A button of a device that cuts: while it is held, the tool is led with a blade in place of its tip.
//!
//! A tool changes its tip only after a release. A blade may begin within the tissue, a tip that touches may not: where it begins tells its side
//! of the surface. So after the button is let go the blade is *sheathed*, with an edge too short to cut, until the tool is out of the tissue.

use glam::{DQuat, DVec3};
use palpate_haptics::{Tip, TipShape};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;

/// A button by which a device cuts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutButton {
    /// Its number among [`crate::HapticDevice::buttons`].
    pub button: u32,
    /// Length of the blade's edge, m, above 0. It runs from the tool's place along z of the device, turned with its handle.
    pub length_m: f64,
}

/// Length of the edge of a sheathed blade, m.
const SHEATHED_M: f64 = 1e-6;

/// What a tool with such a button is led with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Blade {
    /// With its tip.
    Away,
    /// With a blade.
    Cuts,
    /// With a blade that cuts no more, and may still be in the tissue.
    Sheathed,
}

/// The tip of a tool with a button that cuts.
#[derive(Debug)]
pub(super) struct CuttingTip {
    tip: Tip,
    button: CutButton,
    blade: Blade,
    /// Whether the next pose follows a release in any case: another connection may have left the tool in the tissue with a blade.
    is_new: bool,
    /// A place of the surface at the tool, and its normal there, by the newest sample since the blade was sheathed.
    surface_m: Option<(DVec3, DVec3)>,
}

impl CuttingTip {
    pub(super) fn new(tip: Tip, button: CutButton) -> Self {
        CuttingTip { tip, button, blade: Blade::Away, is_new: true, surface_m: None }
    }

    /// Returns the tip with which the tool is led to `place_m`, m, while these buttons are pressed, and whether it must be released first.
    pub(super) fn next(&mut self, place_m: DVec3, orientation: DQuat, buttons: u32) -> (Tip, bool) {
        let is_held = buttons.checked_shr(self.button.button).unwrap_or(0) & 1 != 0;
        let is_out = || self.surface_m.is_some_and(|(surface_m, normal)| (place_m - surface_m).dot(normal) > 0.0);
        let before = self.blade;
        self.blade = match before {
            _ if is_held => Blade::Cuts,
            Blade::Away => Blade::Away,
            Blade::Sheathed if is_out() => Blade::Away,
            Blade::Cuts | Blade::Sheathed => Blade::Sheathed,
        };
        if self.blade != Blade::Sheathed {
            self.surface_m = None;
        }
        let length_m = if self.blade == Blade::Cuts { self.button.length_m } else { SHEATHED_M };
        let turn = if orientation.is_finite() { orientation } else { DQuat::IDENTITY };
        let blade = Tip { shape: TipShape::Blade, grasps: false, edge_m: length_m * (turn * DVec3::Z), ..self.tip };
        let tip = if self.blade == Blade::Away { self.tip } else { blade };
        let is_released = std::mem::take(&mut self.is_new) || (before == Blade::Away) != (self.blade == Blade::Away);
        (tip, is_released)
    }

    /// Lets the next pose follow another release: the server refused the tip.
    pub(super) fn release_again(&mut self) {
        self.is_new = true;
    }

    /// Learns from a sample of the tool where the surface is.
    pub(super) fn take(&mut self, sample: &pb::ToolSample) {
        if let Some(model) = sample.local_model.as_ref().filter(|_| self.blade == Blade::Sheathed) {
            self.surface_m = Some((from_vector(model.surface_m.as_ref()), from_vector(model.normal.as_ref())));
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_proto::geometry::vector;

    use super::*;

    #[test]
    fn a_blade_is_sheathed_when_its_button_is_let_go_and_put_away_once_it_is_out_of_the_tissue() {
        let mut tip = CuttingTip::new(Tip::default(), CutButton { button: 2, length_m: 0.02 });
        let surface = pb::ToolSample {
            local_model: Some(pb::LocalModel {
                surface_m: vector(DVec3::ZERO),
                normal: vector(DVec3::Z),
                ..Default::default()
            }),
            ..Default::default()
        };
        let at = |tip: &mut CuttingTip, z_m: f64, buttons: u32| {
            let (now, is_released) = tip.next(z_m * DVec3::Z, DQuat::from_rotation_y(1.0), buttons);
            (now.shape, now.edge_m.length(), is_released)
        };
        assert_eq!(at(&mut tip, -0.001, 0b11), (TipShape::Disc, 0.0, true));
        assert_eq!(at(&mut tip, -0.001, 0b11), (TipShape::Disc, 0.0, false));
        let (shape, length_m, is_released) = at(&mut tip, -0.001, 0b100);
        assert!(shape == TipShape::Blade && (length_m - 0.02).abs() < 1e-15 && is_released);
        // What was known of the surface before is of another place.
        tip.take(&surface);
        for z_m in [-0.002, 0.001] {
            let (shape, length_m, is_released) = at(&mut tip, z_m, 0);
            assert!(shape == TipShape::Blade && length_m < 2e-6 && !is_released, "{z_m}");
        }
        tip.take(&surface);
        assert_eq!(at(&mut tip, -0.001, 0).0, TipShape::Blade);
        assert_eq!(at(&mut tip, 0.001, 0), (TipShape::Disc, 0.0, true));
        // A device without such a button never cuts.
        let mut none = CuttingTip::new(Tip::default(), CutButton { button: 40, length_m: 0.02 });
        assert_eq!(none.next(DVec3::ZERO, DQuat::IDENTITY, u32::MAX).0, Tip::default());
    }
}
