//! The pressure of an enclosed volume on its points: when it is computed again, and which tiles it wakes.
//!
//! There is one pressure for the whole mesh. A tile falls asleep in balance with the pressure of that moment.
//! It wakes when the pressure has changed so much since then that one of its points would move by more than it
//! may (`sleep::tiles`), as for a change of the tools' force. Until it wakes, its contribution to the volume
//! stays the same, so that its own omitted movement, which would change the pressure back a little, is within
//! the same bound.

use crate::kernel::real::Real;
use crate::state::tissue_state::TissueState;

impl<T: Real> TissueState<T> {
    /// Returns the growth of the volume, in cubes of the unit of length; 0 without a volume.
    pub(crate) fn volume_change(&self) -> f64 {
        let fresh = || self.tables.volume_change(&self.state.u, self.tiles.region.tiles());
        self.known_volume_change.get().unwrap_or_else(fresh)
    }

    /// Computes the growth of the volume and keeps it until the state changes: between two steps many points
    /// may be read.
    pub(crate) fn keep_growth(&self) {
        if self.tables.pressure.is_some() && self.known_volume_change.get().is_none() {
            self.known_volume_change.set(Some(self.volume_change()));
        }
    }

    /// Sets the pressure of the next sweep for the present points. Returns the growth of the volume.
    pub(crate) fn apply_volume_pressure(&self) -> f64 {
        let volume_change = self.tables.volume_change(&self.state.u, self.tiles.region.tiles());
        self.tables.apply_volume_pressure(volume_change);
        volume_change
    }

    /// Returns the energy of the pressure, J.
    pub(crate) fn pressure_j(&self, volume_change: f64) -> f64 {
        let Some(volume) = self.model.places.volume() else { return 0.0 };
        let unit_m = self.model.unit_m;
        0.5 * self.model.scene.volume_stiffness_pa * volume.stretch_m * (volume_change * unit_m).powi(2)
    }

    /// Wakes the tiles on which the pressure has changed by as much as a movement of `far` spacings changes the
    /// force of anchor springs.
    pub(crate) fn wake_what_is_pressed(&mut self, volume_change: f64, far: f64) {
        let TissueState { model, tiles, .. } = self;
        let Some(graph) = model.places.surface() else { return };
        let Some(volume) = &graph.volume else { return };
        let scene = &model.scene;
        let stiffness = scene.volume_stiffness_pa * volume.stretch_m;
        tiles.wake_pressed(volume_change, &volume.reaches, stiffness, far * scene.anchor_stiffness_n_per_m);
    }
}
