//! Haptic devices: the limits that a client declares for its device, so that no larger force is requested from it.

use crate::force_law::{Law, Row};

/// Limits of a haptic device, as its client declares them. All values are positive; a torque of 0 means none.
///
/// The force on a Touch is at most 3.3 N. Its own loop renders 400 N/m stably, which a tissue of 1000 N/m exceeds:
///
/// ```
/// use palpate_haptics::{Device, Law};
///
/// let touch = Device::named("touch").expect("a device of the table");
/// assert_eq!((touch.most_n(), touch.stiffness_n_per_m), (3.3, 400.0));
/// assert!(touch.warnings(&Law::linear(300.0, 0.5)).is_empty());
/// let warnings = touch.warnings(&Law::linear(1000.0, 0.5));
/// assert_eq!(warnings, ["the tissue's stiffness reaches 1000 N/m, above the device's 400 N/m: it may shake"]);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Device {
    /// Name by which [`Device::named`] finds it, in lower case.
    pub name: &'static str,
    /// Largest force that it can exert for a short time, N.
    pub force_n: f64,
    /// Largest force for longer than [`CONTINUOUS_S`], N.
    pub continuous_n: f64,
    /// Largest stiffness that its own loop renders stably, N/m.
    pub stiffness_n_per_m: f64,
    /// Largest damping that its own loop renders stably, N·s/m.
    pub damping_n_s_per_m: f64,
    /// Radius of its workspace, a sphere, m.
    pub workspace_m: f64,
    /// Largest torque that it can exert for a short time, N·m; 0 if it renders none.
    pub torque_n_m: f64,
}

/// Largest force on a person with any device, N; a stronger device is limited to it ([`Device::most_n`]).
pub const SAFE_FORCE_N: f64 = 3.3;

/// Largest force of a device whose client declares no limits, N.
pub const UNDECLARED_FORCE_N: f64 = 2.0;

/// Longest time for which a device may exceed its continuous force ([`Device::continuous_n`]), s. Time below that
/// force counts back at the same rate.
pub const CONTINUOUS_S: f64 = 2.0;

const fn device(
    name: &'static str,
    force_n: f64,
    continuous_n: f64,
    stiffness_n_per_m: f64,
    damping_n_s_per_m: f64,
    workspace_m: f64,
) -> Device {
    Device { name, force_n, continuous_n, stiffness_n_per_m, damping_n_s_per_m, workspace_m, torque_n_m: 0.0 }
}

const fn with_torque(device: Device, torque_n_m: f64) -> Device {
    Device { torque_n_m, ..device }
}

/// Known devices with the data of their makers. Where a maker gives no continuous force, it is the largest force. The
/// data of the Inverse3 is unverified.
pub const DEVICES: [Device; 9] = [
    device("touch", 3.3, 3.3, 400.0, 4.0, 0.075),
    device("omni", 3.3, 0.88, 700.0, 5.0, 0.10),
    device("desktop", 7.9, 7.9, 1000.0, 5.0, 0.10),
    device("falcon", 8.0, 8.0, 3000.0, 20.0, 0.04),
    device("omega3", 12.0, 12.0, 5000.0, 30.0, 0.075),
    device("delta3", 20.0, 20.0, 5000.0, 30.0, 0.15),
    with_torque(device("sigma7", 12.0, 12.0, 4000.0, 30.0, 0.075), 0.4),
    with_torque(device("lambda7", 12.0, 12.0, 8000.0, 30.0, 0.1125), 0.2),
    device("inverse3", 10.0, 10.0, 1000.0, 6.0, 0.15),
];

/// Limits of a device whose client declares none: 2 N ([`UNDECLARED_FORCE_N`]), 400 N/m, 4 N·s/m, and a workspace of
/// 75 mm. [`Device::named`] does not find it.
pub const UNDECLARED: Device = device("undeclared", UNDECLARED_FORCE_N, UNDECLARED_FORCE_N, 400.0, 4.0, 0.075);

impl Device {
    /// Returns the device of [`DEVICES`] whose name is `name` exactly, in lower case; `None` if there is none.
    pub fn named(name: &str) -> Option<Self> {
        DEVICES.iter().find(|device| device.name == name).copied()
    }

    /// Returns the largest force requested from it, N: its own limit, but at most [`SAFE_FORCE_N`].
    pub fn most_n(&self) -> f64 {
        self.force_n.min(SAFE_FORCE_N)
    }

    /// Returns the lever at which its largest force exerts its largest torque, m; 0 if it renders no torque.
    pub fn lever_m(&self) -> f64 {
        self.torque_n_m / self.force_n
    }

    /// Returns the largest torque requested from it, N·m: that of the largest force requested ([`Device::most_n`]) at its lever.
    pub fn most_n_m(&self) -> f64 {
        self.lever_m() * self.most_n()
    }

    /// Returns a text for each limit of stable rendering that a tissue with `law` exceeds: stiffness, then damping,
    /// along the normal, in the rows up to the first that reaches the largest force requested ([`Device::most_n`]).
    /// Empty if there are none. The tissue is rendered unchanged; if the loop becomes unstable, the envelope removes
    /// the energy that it produces. Panics if the law has no row.
    pub fn warnings(&self, law: &Law) -> Vec<String> {
        let reached = law.rows.iter().position(|row| row.force_n >= self.most_n()).unwrap_or(law.rows.len() - 1);
        let most = |of: fn(&Row) -> f64| law.rows[..=reached].iter().map(of).fold(0.0, f64::max);
        let stiffness = ("stiffness", "N/m", most(|row| row.stiffness_n_per_m), self.stiffness_n_per_m);
        let damping = ("damping", "N·s/m", most(|row| row.damping_n_s_per_m), self.damping_n_s_per_m);
        let beyond = [stiffness, damping].into_iter().filter(|(_, _, tissue, device)| tissue > device);
        let words = |(name, unit, tissue, device): (&str, &str, f64, f64)| {
            format!(
                "the tissue's {name} reaches {tissue:.0} {unit}, above the device's {device:.0} {unit}: it may shake"
            )
        };
        beyond.map(words).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Row k is met with k/2 N and has a stiffness of 100·k N/m.
    fn hardening(rows: u32) -> Law {
        let row = |k: u32| Row {
            force_n: 0.5 * f64::from(k),
            stiffness_n_per_m: 100.0 * f64::from(k),
            damping_n_s_per_m: 1.0,
            ..Row::default()
        };
        Law { step_m: 1e-3, rows: (0..rows).map(row).collect(), is_coarse: false }
    }

    #[test]
    fn warnings_name_what_a_device_is_asked_for_beyond_its_limits() {
        // The largest force is met in the row of 400 N/m. The harder rows are never rendered.
        let device = Device { force_n: 2.0, stiffness_n_per_m: 400.0, ..UNDECLARED };
        assert!(device.warnings(&hardening(10)).is_empty());
        let softer = Device { stiffness_n_per_m: 300.0, ..device };
        let said = softer.warnings(&hardening(10));
        assert!(
            said.len() == 1 && said[0].contains("stiffness reaches 400 N/m, above the device's 300 N/m"),
            "{said:?}"
        );
        // A law that ends below the largest force counts up to its last row.
        assert!(softer.warnings(&hardening(4)).is_empty());
        assert_eq!(Device { stiffness_n_per_m: 200.0, ..device }.warnings(&hardening(4)).len(), 1);
        let said = Device { stiffness_n_per_m: 10.0, damping_n_s_per_m: 0.5, ..device }.warnings(&hardening(10));
        assert!(said.len() == 2 && said[1].contains("damping reaches 1 N·s/m"), "{said:?}");
    }
}
