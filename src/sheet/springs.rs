//! The elastic force: every spring once, row by row.
//!
//! With D0 the rest vector of a spring a–b, Δ = u_b − u_a and q = (2·D0·Δ + Δ·Δ)/L0², its length is L = s·L0,
//! s = √(1 + q), and 1 − L0/L = q/(s(1 + s)): the extension without the cancellation that L − L0 has. So
//!
//! force on a = k(1 − L0/L)(x_b − x_a) = k·q/(s(1 + s))·(D0 + Δ),  energy = ½k(L − L0)² = ½k·L0²·(q/(1 + s))².

use super::model::{Link, Model};
use super::real::Real;

/// Least 1 + q = (L/L0)². A spring pressed to no length at all has no direction; below a millionth of its rest
/// length its force fades to 0 in proportion to its length, so that nothing divides by 0.
const LEAST_LENGTH_SQUARED: f64 = 1e-12;

/// A link with its constants in the format of the state.
#[derive(Debug, Clone, Copy)]
struct Spring<T> {
    di: usize,
    dj: isize,
    stiffness: T,
    rest: [T; 2],
    per_length_squared: T,
}

impl<T: Real> Spring<T> {
    fn of(link: &Link) -> Self {
        let [x, y] = link.rest_m;
        Spring {
            di: link.di,
            dj: link.dj,
            stiffness: T::of(link.stiffness_n_per_m),
            rest: [T::of(x), T::of(y)],
            per_length_squared: T::of((x * x + y * y).recip()),
        }
    }

    /// q and s for Δ.
    #[inline(always)]
    fn stretch(&self, [x, y, z]: [T; 3]) -> (T, T) {
        let along = self.rest[0] * x + self.rest[1] * y;
        let q = (along + along + (x * x + y * y + z * z)) * self.per_length_squared;
        let (square, least) = (T::ONE + q, T::of(LEAST_LENGTH_SQUARED));
        (q, if square > least { square } else { least }.root())
    }

    /// The force on a.
    #[inline(always)]
    fn force(&self, delta: [T; 3]) -> [T; 3] {
        let (q, s) = self.stretch(delta);
        let c = self.stiffness * (q / (s * (T::ONE + s)));
        [c * (self.rest[0] + delta[0]), c * (self.rest[1] + delta[1]), c * delta[2]]
    }
}

/// All springs of a sheet, and the room to sum them in.
#[derive(Debug)]
pub(super) struct Springs<T> {
    springs: Vec<Spring<T>>,
    points: [usize; 2],
    row: [Vec<T>; 3],
}

impl<T: Real> Springs<T> {
    pub(super) fn new(model: &Model) -> Self {
        Springs {
            springs: model.links.iter().map(Spring::of).collect(),
            points: model.points,
            row: std::array::from_fn(|_| vec![T::default(); model.points[1]]),
        }
    }

    /// The spans of row `i` and of the row that `spring` leads to, which its springs join.
    fn spans(&self, spring: &Spring<T>, i: usize) -> Option<(usize, usize, usize)> {
        let [nx, ny] = self.points;
        let reach = spring.dj.unsigned_abs();
        if i + spring.di >= nx || reach >= ny {
            return None;
        }
        // Of row i, columns from `a` on; of the other, from `b` on.
        let (a, b) = if spring.dj < 0 { (reach, 0) } else { (0, reach) };
        Some((i * ny + a, (i + spring.di) * ny + b, ny - reach))
    }

    /// Sets `f` to the sum of the forces of all springs at displacement `u`.
    pub(super) fn forces(&mut self, u: &[Vec<T>; 3], f: &mut [Vec<T>; 3]) {
        for component in f.iter_mut() {
            component.fill(T::default());
        }
        let mut row = std::mem::take(&mut self.row);
        for i in 0..self.points[0] {
            for spring in &self.springs {
                let Some((a, b, len)) = self.spans(spring, i) else { continue };
                // Out of the arrays first, and back after: the two spans may share points, which would
                // keep the compiler from using vectors.
                let [tx, ty, tz] = row.each_mut().map(|t| &mut t[..len]);
                let [ax, ay, az] = [&u[0][a..a + len], &u[1][a..a + len], &u[2][a..a + len]];
                let [bx, by, bz] = [&u[0][b..b + len], &u[1][b..b + len], &u[2][b..b + len]];
                for j in 0..len {
                    [tx[j], ty[j], tz[j]] = spring.force([bx[j] - ax[j], by[j] - ay[j], bz[j] - az[j]]);
                }
                for (f, t) in f.iter_mut().zip([tx, ty, tz]) {
                    f[a..a + len].iter_mut().zip(t.iter()).for_each(|(f, t)| *f += *t);
                    f[b..b + len].iter_mut().zip(t.iter()).for_each(|(f, t)| *f -= *t);
                }
            }
        }
        self.row = row;
    }

    /// The energy of all springs at displacement `u`, J.
    pub(super) fn energy_j(&self, u: &[Vec<T>; 3]) -> f64 {
        let mut sum = 0.0;
        for i in 0..self.points[0] {
            for spring in &self.springs {
                let Some((a, b, len)) = self.spans(spring, i) else { continue };
                for j in 0..len {
                    let (q, s) = spring.stretch(std::array::from_fn(|c| u[c][b + j] - u[c][a + j]));
                    let extension = (q / (T::ONE + s)).wide();
                    sum += 0.5 * spring.stiffness.wide() / spring.per_length_squared.wide() * extension * extension;
                }
            }
        }
        sum
    }
}
