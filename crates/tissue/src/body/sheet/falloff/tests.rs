//! Tests of falloffs at every width.

use super::*;
use crate::scene::Lanes;

fn factors<T: Real>(lanes: Lanes, centre: f64) -> Vec<f64> {
    let (stride, per_spacing) = (64, 1.7);
    let reach = -T::NEGLIGIBLE_EXPONENT / per_spacing;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let columns = (centre - reach).ceil() as usize..(centre + reach).floor() as usize + 1;
    let mut factors = vec![T::default(); stride];
    let factor = factors.as_mut_ptr();
    let falloff = Falloff { centre: [0.0, centre], per_spacing, rows: 0..1, columns, stride, factors: factor };
    // SAFETY: there is one row, of whole blocks.
    unsafe { lanes::run(Width::of(lanes), &falloff) };
    factors.into_iter().map(Real::wide).collect()
}

/// A reach that ends between two lanes must end at the same point for every width.
#[test]
fn a_falloff_has_the_same_bits_at_every_width_wherever_it_ends() {
    let mut nonzero = 0;
    for place in 0..4000 {
        let centre = 24.0 + 0.00391 * f64::from(place);
        for (plain, other) in [
            (factors::<f32>(Lanes::Plain, centre), factors::<f32>(Lanes::Auto, centre)),
            (factors::<f64>(Lanes::Plain, centre), factors::<f64>(Lanes::Auto, centre)),
        ] {
            assert_eq!(plain, other, "centre {centre}");
            nonzero += plain.iter().filter(|factor| **factor != 0.0).count();
        }
    }
    assert!(nonzero > 4000 * 20, "{nonzero}");
    // Skip a point at the very end of the reach: f32 may count it as inside.
    for at in 0..24 {
        let centre = f64::from(at) + 22.0 / 1.7 + 1e-9;
        assert_eq!(factors::<f32>(Lanes::Plain, centre), factors::<f32>(Lanes::Auto, centre), "centre {centre}");
    }
}
