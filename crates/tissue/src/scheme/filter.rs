//! What a branch keeps of the springs' past.
//!
//! A branch adds γ·(N − z) to the springs' force N, where ż = (N − z)/θ, with θ = τ/dt substeps. With N linear over a substep, and
//! e = e^(−1/θ), f = θ·(1 − e), z₊ = e·z + (f − e)·N + (1 − f)·N₊. One kept value s, with z = f·s + (1 − f)·N at the time of N, gives the
//! same: s₊ = e·s + (1 − e)·N. Where the springs' force does not change, s, z and N become equal, so that a tissue at rest keeps its
//! springs' force in each field. A branch that is faster than a substep counts as one of a substep.
//!
//! **Work.** The guard takes the work of a force as that of its mean over an increment, and so needs what the branches added a
//! substep ago. The scheme keeps the whole force M = N + Σ γ·(N − z) of that time. From z₋ = f·s₋ + (1 − f)·N₋ and
//! s = e·s₋ + (1 − e)·N₋ follows γ·(N₋ − z₋) = (γ·f/e)·(N₋ − s), and with w = 1 + Σ γ·f/e so N₋ = (M₋ + Σ (γ·f/e)·s)/w.

use super::oscillator::ScaledBranch;

/// A branch's filter for a substep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BranchFilter {
    /// e: the part of s that is left after a substep.
    pub(super) keeps: f64,
    /// f: the part of s in z.
    pub(super) past: f64,
    /// γ·f: the branch adds this times N − s.
    pub(super) pull: f64,
}

impl BranchFilter {
    /// Creates the filter of a branch.
    pub(super) fn of(branch: ScaledBranch) -> Self {
        let ScaledBranch { stiffness, substeps } = branch;
        let substeps = substeps.max(1.0);
        let lost = -libm::expm1(-1.0 / substeps);
        let past = substeps * lost;
        BranchFilter { keeps: 1.0 - lost, past, pull: stiffness * past }
    }

    /// Returns the weight of N in N + Σ γ·(N − z); that of each s is −γ·f.
    pub(super) fn whole(filters: &[Self]) -> f64 {
        1.0 + filters.iter().map(|filter| filter.pull).sum::<f64>()
    }

    /// Returns the weights of N and of each s in `weight` times N + Σ γ·(N − z).
    pub(super) fn weights<const N: usize>(weight: f64, filters: &[Self; N]) -> (f64, [f64; N]) {
        (weight * Self::whole(filters), filters.map(|filter| -weight * filter.pull))
    }

    /// Returns the weights of N and M₋, and of each s, in the mean of the branches' force now and a substep ago.
    pub(super) fn means<const N: usize>(filters: &[Self; N]) -> ([f64; 2], [f64; N]) {
        let before = 1.0 + filters.iter().map(|filter| filter.pull / filter.keeps).sum::<f64>();
        let of_s = |filter: Self| -0.5 * (filter.pull + filter.pull / filter.keeps / before);
        ([0.5 * (Self::whole(filters) - 1.0), 0.5 * (1.0 - 1.0 / before)], filters.map(of_s))
    }

    /// Returns s for another substep, so that z stays the same; `now` is the springs' force.
    pub(super) fn resampled(&self, to: &Self, now: f64, s: f64) -> f64 {
        let z = self.past * s + (1.0 - self.past) * now;
        (z - (1.0 - to.past) * now) / to.past
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_follow_a_force_that_rises_evenly() {
        const TIMES: [f64; 3] = [1.0, 4.0, 250.0];
        // Of ż = (t − z)/θ with z = 0 at first.
        let truth = |t: f64, time: f64| t - time * (1.0 - (-t / time).exp());
        let of =
            |ratio: f64| TIMES.map(|time| BranchFilter::of(ScaledBranch { stiffness: 0.7, substeps: ratio * time }));
        let (filters, finer) = (of(1.0), of(2.0));
        let ([of_now, of_before], of_s) = BranchFilter::means(&filters);
        let (mut s, mut before) = ([0.0; 3], [0.0; 2]);
        for t in 0..1000 {
            let now = f64::from(t);
            let within = |found: f64, truth: f64| (found - truth).abs() < 1e-9 * (1.0 + now);
            let mut pull = 0.0;
            for ((filter, finer), (s, time)) in filters.iter().zip(&finer).zip(s.iter().zip(TIMES)) {
                let z = filter.past * s + (1.0 - filter.past) * now;
                assert!(within(z, truth(now, time)), "{time} {t}: {z}");
                let other = filter.resampled(finer, now, *s);
                assert!(within(finer.past * other + (1.0 - finer.past) * now, z), "{time} {t}");
                pull += 0.7 * (now - z);
            }
            let added: f64 = filters.iter().zip(&s).map(|(filter, s)| filter.pull * s).sum();
            assert!(within(BranchFilter::whole(&filters) * now - added, now + pull), "{t}");
            let [pulled, whole] = before;
            let mean = of_now * now + of_before * whole + of_s.iter().zip(&s).map(|(of, s)| of * s).sum::<f64>();
            assert!(t == 0 || within(mean, 0.5 * (pull + pulled)), "{t}: {mean}");
            before = [pull, now + pull];
            s.iter_mut().zip(&filters).for_each(|(s, filter)| *s = filter.keeps * *s + (1.0 - filter.keeps) * now);
        }
    }
}
