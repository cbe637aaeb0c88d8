//! The reports of a SpaceMouse as a human interface device (HID).
//!
//! They are those of 3Dconnexion's devices since the SpaceNavigator: number 1 has the translation as three 16-bit numbers,
//! little-endian, with a rotation after it or in report 2; number 3 has the buttons, one bit each.

use glam::DVec3;

use super::velocity_control::dead;

/// 3Dconnexion, and Logitech, which sold these devices earlier; a Logitech device is recognized by its name.
const VENDORS: [u16; 2] = [0x256f, 0x046d];
const NAMES: [&str; 4] = ["3Dconnexion", "SpaceMouse", "SpaceNavigator", "SpacePilot"];

/// The largest value of an axis.
const FULL: f64 = 350.0;

/// What the reports so far say.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Reported {
    /// The translation: to the right, towards the operator, and down, as fractions of the largest.
    axes: [f64; 3],
    /// Bit 0 (the first button) requests forces; bit 1 is the clutch.
    pub(super) buttons: u32,
}

impl Reported {
    /// Applies a report, as it is read: its number, then its content. Other reports have no effect.
    pub(super) fn take(&mut self, report: &[u8]) {
        match report {
            [1, axes @ ..] if axes.len() >= 6 => {
                let axis = |k: usize| f64::from(i16::from_le_bytes([axes[2 * k], axes[2 * k + 1]])) / FULL;
                self.axes = [axis(0), axis(1), axis(2)];
            }
            [3, buttons, ..] => self.buttons = u32::from(buttons & 3),
            _ => {}
        }
    }

    /// Returns the velocity of the position, as a fraction of the largest.
    pub(super) fn velocity(&self) -> DVec3 {
        let [right, near, down] = self.axes.map(dead);
        DVec3::new(right, -near, -down).clamp_length_max(1.0)
    }
}

/// Returns whether a device of this vendor and product name counts as a SpaceMouse: every one of 3Dconnexion does.
pub(super) fn is_space_mouse(vendor: u16, product: &str) -> bool {
    vendor == VENDORS[0] || vendor == VENDORS[1] && NAMES.iter().any(|name| product.contains(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_moves_to_the_right_away_and_down_and_rests_at_zero() {
        let mut reported = Reported::default();
        // 200 to the right, 200 away from the operator, 200 down; a rotation follows in newer devices.
        let [right, away, down] = [200_i16, -200, 200].map(i16::to_le_bytes);
        let report = [&[1][..], &right, &away, &down, &[0; 6]].concat();
        reported.take(&report);
        let velocity = reported.velocity();
        assert!(velocity.x > 0.3 && velocity.y > 0.3 && velocity.z < -0.3, "{velocity}");
        reported.take(&[3, 0b101, 0]);
        assert_eq!(reported.buttons, 1);
        // A rotation of its own, a report that is cut off, and an empty one change nothing.
        let before = Reported { ..reported };
        for report in [&[2, 255, 255, 255, 255, 255, 255][..], &[1, 9, 9], &[3], &[]] {
            reported.take(report);
        }
        assert_eq!(reported, before);
        reported.take(&[1, 0, 0, 0, 0, 0, 0]);
        assert_eq!(reported.velocity(), DVec3::ZERO);
    }

    #[test]
    fn the_maker_is_known_by_its_number_and_the_former_one_by_its_names() {
        assert!(is_space_mouse(0x256f, "") && is_space_mouse(0x046d, "SpaceNavigator for Notebooks"));
        assert!(!is_space_mouse(0x046d, "USB Optical Mouse") && !is_space_mouse(0x1234, "SpaceMouse"));
    }
}
