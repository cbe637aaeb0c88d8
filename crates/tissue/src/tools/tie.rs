//! Threads and clips in a tissue: what they hold, and with which force.
//!
//! A bite is a disc (`footprint`) that stays at its place of the tissue; s = Σ w·x is where it is. Between two discs, a force F on the one
//! and −F on the other move them towards each other by A·F, where A is the sum of their relative inverse masses, less twice
//! Σ w·w′/m of the points that both cover. So the force at the end of a substep follows from a division, as that of a tool on a
//! spring does (`contact`): F = (gap without F)/(A + c), with the compliance c of the thread. It is stable however small c is,
//! and the tissue gains no energy from it.
//!
//! **A thread** through n bites has n − 1 parts, each as long as the thread that is in it, and stretched by at most a thousandth for each newton. It
//! only pulls. At a bite between two parts it slides from the one with less tension to the other as long as one tension is more than e^{μθ}
//! times the other, with the angle θ by which it turns there: the capstan equation of Euler (Remarques sur l'effet du
//! frottement dans l'équilibre, Mémoires de l'académie des sciences de Berlin 18, 1769). All parts are solved together, by a
//! few sweeps over them (Gauss–Seidel), in a fixed order. Its work is that of its end, which is drawn in at the last bite: tension times way.
//! What slides loses energy.
//!
//! **A clip** holds its two bites together in all three directions. It closes at the speed of a thread that is drawn in.

use std::sync::Arc;

use glam::DVec3;

use crate::body::footprint::Footprint;
use crate::body::model::Model;
use crate::body::solid::corner_copies::CornerCopies;
use crate::saved::{Checks, LARGEST, SavedBites, SavedTie, Vector, ensure};
use crate::scene::action_check::check_tie;
use crate::scene::tie::{Bite, Tie, TieKind};
use palpate_refusal::Result;

/// How much a thread is stretched by a tension of 1 N, as a part of its length.
const STRETCH_PER_N: f64 = 1e-3;

/// The least compliance of a part of a thread, and that of a clip, m/N.
const MIN_COMPLIANCE_M_PER_N: f64 = 1e-6;

/// How fast a thread is drawn in, and a clip closes, at most, m/s.
const MAX_DRAWING_M_PER_S: f64 = 0.1;

/// Tension beyond which no thread is drawn in farther, N: no hand ties a knot with more.
const MAX_DRAWING_N: f64 = 100.0;

/// The most sweeps over the parts of a thread in a substep. What is left is solved in the next ones.
const MAX_SWEEPS: usize = 200;

/// Tensions of parts are solved to this part of the largest one.
const TOLERANCE: f64 = 1e-12;

/// A thread or clip in a tissue ([`Tissue::ties`](crate::Tissue::ties)).
#[derive(Debug, Clone, PartialEq)]
pub struct TieState {
    /// Its number.
    pub number: usize,
    /// The tie as it was laid or last changed.
    pub tie: Tie,
    /// Tension of each part between two bites, N, as a mean over the last step: of a clip the force between its bites.
    pub tensions_n: Vec<f64>,
    /// The largest tension of a part in any step so far, N.
    pub peak_n: f64,
    /// Length of the thread without its stretch, m; of a clip how far it is from being closed.
    pub length_m: f64,
    /// Sum of the distances between successive bites, m.
    pub path_m: f64,
    /// Whether it has broken, and no longer holds anything.
    pub is_broken: bool,
    /// Where the bites are, m.
    pub places_m: Vec<DVec3>,
}

/// All threads and clips of a tissue.
#[derive(Debug, Clone, Default)]
pub(crate) struct Ties {
    /// By ascending number. Clones share what does not change.
    pub(crate) laid: Vec<LaidTie>,
}

/// A thread or clip, and the discs of its bites.
#[derive(Debug, Clone)]
pub(crate) struct LaidTie {
    pub(crate) number: usize,
    pub(crate) tie: Tie,
    pub(crate) discs: Arc<TiedDiscs>,
    /// The length of the thread in each part, m; empty for a clip.
    pub(crate) lengths_m: Vec<f64>,
    /// How far a clip still holds its second bite from the first, m; 0 for a thread.
    pub(crate) apart_m: DVec3,
    /// Force with which each part pulls its first bite towards the second at the end of the last substep, N.
    pub(crate) forces_n: Vec<DVec3>,
    /// Sum of the tensions of this step's substeps, N; between steps their mean in the last one.
    pub(crate) tensions_n: Vec<f64>,
    pub(crate) peak_n: f64,
    pub(crate) is_broken: bool,
}

/// The discs of the bites of a tie.
#[derive(Debug)]
pub(crate) struct TiedDiscs {
    pub(crate) footprints: Vec<Footprint>,
    /// Σ w·w′/m over the movable points of each two discs, row by row.
    inverse_masses: Vec<f64>,
}

impl TiedDiscs {
    fn new(model: &Model, bites: &[Bite], copies: Option<&Arc<CornerCopies>>) -> Self {
        let footprint = |bite: &Bite| {
            let mut footprint = Footprint::new(model, bite.radius_m, bite.place_m);
            footprint.follow_cuts(model, copies);
            footprint
        };
        let footprints: Vec<Footprint> = bites.iter().map(footprint).collect();
        // By place, so that the points of two discs are found and added up in one order.
        let nodes = |footprint: &Footprint| {
            let free = footprint.reached().iter().filter(|node| node.free && footprint.relative_inverse_mass() > 0.0);
            let mut nodes: Vec<(usize, f64, f64)> =
                free.map(|node| (model.index_of(node.point), node.weight, node.mass)).collect();
            nodes.sort_unstable_by_key(|node| node.0);
            nodes
        };
        let nodes: Vec<_> = footprints.iter().map(nodes).collect();
        let shared = |[one, other]: [usize; 2]| {
            let of = |(place, weight, mass): &(usize, f64, f64)| {
                let found = nodes[other].binary_search_by_key(place, |node| node.0).ok()?;
                Some(weight * nodes[other][found].1 / mass)
            };
            nodes[one].iter().filter_map(of).sum::<f64>()
        };
        let count = bites.len();
        let pairs = (0..count * count).map(|pair| [pair / count, pair % count]);
        // The same bits in both orders.
        let inverse_masses = pairs.map(|[i, j]| shared([i.min(j), i.max(j)])).collect();
        TiedDiscs { footprints, inverse_masses }
    }

    /// Returns Σ w·w′/m of two discs.
    pub(crate) fn inverse_mass(&self, one: usize, other: usize) -> f64 {
        self.inverse_masses[one * self.footprints.len() + other]
    }

    /// Returns the change of the vector of part `one` (from its first disc to its second) under a force of 1 with which part
    /// `other` draws its discs together, in relative inverse masses: how much shorter it becomes, if both have the same direction.
    fn part_inverse_mass(&self, one: usize, other: usize) -> f64 {
        let of = |a, b| self.inverse_mass(a, b);
        of(one, other) + of(one + 1, other + 1) - of(one, other + 1) - of(one + 1, other)
    }
}

impl Ties {
    /// Lays a tie, changes the one with this number, or with `None` removes it. `displacement_m` gives the displacement of the point at a
    /// row and column, m.
    pub(crate) fn set(
        &mut self,
        model: &Model,
        number: usize,
        tie: Option<Tie>,
        copies: Option<&Arc<CornerCopies>>,
        displacement_m: impl Fn([usize; 2]) -> DVec3,
    ) {
        let found = self.laid.binary_search_by_key(&number, |laid| laid.number);
        let Some(tie) = tie else {
            if let Ok(index) = found {
                self.laid.remove(index);
            }
            return;
        };
        let is_clip = |tie: &Tie| tie.kind == TieKind::Clip;
        if let Ok(index) = found
            && self.laid[index].tie.bites == tie.bites
            && is_clip(&self.laid[index].tie) == is_clip(&tie)
        {
            self.laid[index].tie = tie;
            return;
        }
        let laid = LaidTie::new(model, number, tie, copies, displacement_m);
        match found {
            Ok(index) => self.laid[index] = laid,
            Err(index) => self.laid.insert(index, laid),
        }
    }

    /// Lets the bites hold these copies of a solid's corners; `None` gives up those that they know, but for discs that a checkpoint shares.
    pub(crate) fn follow_cuts(&mut self, model: &Model, copies: Option<&Arc<CornerCopies>>) {
        for laid in &mut self.laid {
            if copies.is_some() {
                laid.discs = Arc::new(TiedDiscs::new(model, &laid.tie.bites, copies));
            } else if let Some(discs) = Arc::get_mut(&mut laid.discs) {
                discs.footprints.iter_mut().for_each(|footprint| footprint.follow_cuts(model, None));
            }
        }
    }

    /// Returns whether there are none.
    pub(crate) fn is_empty(&self) -> bool {
        self.laid.is_empty()
    }

    /// Returns whether none of them pulls, or will pull if the tissue does not move.
    pub(crate) fn are_settled(&self) -> bool {
        self.laid.iter().all(LaidTie::is_settled)
    }

    /// Returns the points at which a tie pulls. Some occur more than once.
    pub(crate) fn points(&self) -> impl Iterator<Item = [usize; 2]> {
        self.laid.iter().filter(|laid| laid.pulls()).flat_map(LaidTie::points)
    }

    /// Returns the force of the ties on the point at a place, N.
    pub(crate) fn force_on(&self, model: &Model, index: usize) -> DVec3 {
        let of_disc = |(footprint, force_n): (&Footprint, DVec3)| footprint.weight_of(model, index) * force_n;
        let of = |laid: &LaidTie| -> DVec3 {
            let discs = laid.discs.footprints.iter().zip(disc_forces_n(&laid.forces_n));
            discs.filter(|(footprint, _)| footprint.relative_inverse_mass() > 0.0).map(of_disc).sum()
        };
        self.laid.iter().filter(|laid| laid.pulls()).map(of).sum()
    }

    /// Returns the energy that the stretch of the ties stores, J.
    pub(crate) fn stored_j(&self) -> f64 {
        let of = |laid: &LaidTie| -> f64 {
            let parts = laid.forces_n.iter().enumerate();
            parts.map(|(part, force_n)| 0.5 * laid.compliance_m_per_n(part) * force_n.length_squared()).sum()
        };
        self.laid.iter().map(of).sum()
    }

    /// Ends a step of `substeps` substeps: tensions become means, and ties beyond their strength break.
    pub(crate) fn finish(&mut self, substeps: u32) {
        for laid in self.laid.iter_mut().filter(|laid| !laid.is_broken) {
            laid.tensions_n.iter_mut().for_each(|tension_n| *tension_n /= f64::from(substeps));
            let most_n = laid.tensions_n.iter().copied().fold(0.0, f64::max);
            laid.peak_n = laid.peak_n.max(most_n);
            if laid.tie.strength_n.is_some_and(|strength_n| most_n > strength_n) {
                laid.is_broken = true;
                laid.forces_n.fill(DVec3::ZERO);
                laid.tensions_n.fill(0.0);
            }
        }
    }

    /// Returns the states of all ties, given the displacement of the point at a row and column, m.
    pub(crate) fn states(&self, displacement_m: impl Fn([usize; 2]) -> DVec3) -> Vec<TieState> {
        let of = |laid: &LaidTie| {
            let places_m = laid.places_m(&displacement_m);
            TieState {
                number: laid.number,
                tie: laid.tie.clone(),
                tensions_n: laid.tensions_n.clone(),
                peak_n: laid.peak_n,
                length_m: laid.lengths_m.iter().sum::<f64>() + laid.apart_m.length(),
                path_m: places_m.windows(2).map(|pair| pair[0].distance(pair[1])).sum(),
                is_broken: laid.is_broken,
                places_m,
            }
        };
        self.laid.iter().map(of).collect()
    }

    /// Adds the ties to the hash of a tissue; nothing if there are none.
    pub(crate) fn hash(&self, add: &mut impl FnMut(&[u8])) {
        if !self.laid.is_empty() {
            add(&(self.laid.len() as u64).to_le_bytes());
        }
        for laid in &self.laid {
            add(&(laid.number as u64).to_le_bytes());
            add(&[u8::from(laid.is_broken)]);
            let vectors = laid.forces_n.iter().chain([&laid.apart_m]).flat_map(DVec3::to_array);
            laid.lengths_m.iter().copied().chain(vectors).for_each(|value| add(&value.to_bits().to_le_bytes()));
        }
    }

    /// Returns the place of a point under a tie whose numbers are not finite, or that `is_good` does not accept.
    pub(crate) fn broken_point(&self, model: &Model, is_good: impl Fn(usize) -> bool) -> Option<usize> {
        self.laid.iter().find_map(|laid| {
            let mut points = laid.points().map(|point| model.index_of(point));
            let vectors = laid.forces_n.iter().chain([&laid.apart_m]).flat_map(DVec3::to_array);
            // NaN is not below the bound.
            if !vectors.chain(laid.lengths_m.iter().copied()).all(|value| value.abs() < LARGEST) {
                return Some(points.next().unwrap_or(0));
            }
            if laid.pulls() { points.find(|index| !is_good(*index)) } else { None }
        })
    }

    pub(crate) fn saved(&self) -> Vec<SavedTie> {
        self.laid.iter().map(LaidTie::saved).collect()
    }

    pub(crate) fn restored(saved: &[SavedTie], model: &Model, checks: &Checks<'_>) -> Result<Self> {
        // Each takes work: first that there are no more than numbers.
        ensure(saved.is_sorted_by(|a, b| a.number < b.number), "threads or clips out of order")?;
        saved.last().map_or(Ok(0), |last| checks.tie(last.number))?;
        let laid = saved.iter().map(|tie| LaidTie::restored(tie, model, checks)).collect::<Result<_>>()?;
        Ok(Ties { laid })
    }
}

impl LaidTie {
    fn new(
        model: &Model,
        number: usize,
        tie: Tie,
        copies: Option<&Arc<CornerCopies>>,
        displacement_m: impl Fn([usize; 2]) -> DVec3,
    ) -> Self {
        let parts = tie.bites.len().saturating_sub(1);
        let mut laid = LaidTie {
            number,
            discs: Arc::new(TiedDiscs::new(model, &tie.bites, copies)),
            lengths_m: Vec::new(),
            apart_m: DVec3::ZERO,
            forces_n: vec![DVec3::ZERO; parts],
            tensions_n: vec![0.0; parts],
            peak_n: 0.0,
            is_broken: false,
            tie,
        };
        let spans_m: Vec<DVec3> = laid.places_m(&displacement_m).windows(2).map(|pair| pair[1] - pair[0]).collect();
        match laid.tie.kind {
            TieKind::Clip => laid.apart_m = spans_m.first().copied().unwrap_or(DVec3::ZERO),
            TieKind::Thread { length_m, .. } => {
                laid.lengths_m = spans_m.iter().map(|span_m| span_m.length()).collect();
                // What it is longer than the way between its bites hangs loose at its end.
                let loose_m = (length_m - laid.lengths_m.iter().sum::<f64>()).max(0.0);
                laid.lengths_m.iter_mut().last().into_iter().for_each(|last_m| *last_m += loose_m);
            }
        }
        laid
    }

    /// Returns whether it pulled at the end of the last substep.
    pub(crate) fn pulls(&self) -> bool {
        self.forces_n.iter().any(|force_n| *force_n != DVec3::ZERO)
    }

    /// Returns whether it neither pulls nor is drawn in.
    fn is_settled(&self) -> bool {
        let is_drawn = match self.tie.kind {
            TieKind::Clip => self.apart_m == DVec3::ZERO,
            TieKind::Thread { length_m, .. } => is_about(self.lengths_m.iter().sum(), length_m),
        };
        self.is_broken || is_drawn && !self.pulls()
    }

    /// Returns the points of its bites. Some may occur more than once.
    pub(crate) fn points(&self) -> impl Iterator<Item = [usize; 2]> {
        self.discs.footprints.iter().flat_map(|footprint| footprint.reached().iter().map(|node| node.point))
    }

    /// Returns where its bites are, m.
    pub(crate) fn places_m(&self, displacement_m: &impl Fn([usize; 2]) -> DVec3) -> Vec<DVec3> {
        self.discs.footprints.iter().map(|footprint| footprint.surface(displacement_m).0).collect()
    }

    /// Returns by how much a part is stretched by a tension of 1 N, m/N.
    fn compliance_m_per_n(&self, part: usize) -> f64 {
        let length_m = self.lengths_m.get(part).copied().unwrap_or(0.0);
        (STRETCH_PER_N * length_m).max(MIN_COMPLIANCE_M_PER_N)
    }

    /// Draws the thread in, or lets it out, or closes the clip, in a substep of `substep_s` that is followed by `more` in this step. Returns
    /// the way, m, along which the force of the last part then does work: of a thread in x.
    pub(crate) fn draw(&mut self, substep_s: f64, more: u32) -> DVec3 {
        let most_m = MAX_DRAWING_M_PER_S * substep_s;
        let tension_n = self.forces_n.last().map_or(0.0, |force_n| force_n.length());
        match self.tie.kind {
            TieKind::Clip if tension_n > MAX_DRAWING_N => DVec3::ZERO,
            TieKind::Clip => {
                let before_m = self.apart_m;
                self.apart_m = before_m.normalize_or_zero() * (before_m.length() - most_m).max(0.0);
                before_m - self.apart_m
            }
            TieKind::Thread { length_m, .. } => {
                let now_m = self.lengths_m.iter().sum::<f64>();
                let longer_m = (length_m - now_m) / f64::from(more + 1);
                let is_drawn = tension_n <= MAX_DRAWING_N || longer_m > 0.0;
                let Some(last_m) = self.lengths_m.last_mut().filter(|_| is_drawn && !is_about(now_m, length_m)) else {
                    return DVec3::ZERO;
                };
                let before_m = *last_m;
                *last_m = (before_m + longer_m.max(-most_m)).max(0.0);
                (before_m - *last_m) * DVec3::X
            }
        }
    }

    /// Returns the work along a way ([`LaidTie::draw`]), J: that of the force at the end of the substep, which acts all through it.
    pub(crate) fn work_j(&self, way_m: DVec3) -> f64 {
        let force_n = self.forces_n.last().copied().unwrap_or(DVec3::ZERO);
        match self.tie.kind {
            TieKind::Clip => force_n.dot(way_m),
            TieKind::Thread { .. } => force_n.length() * way_m.x,
        }
    }

    /// Determines the forces of the parts at the end of a substep, N, from where the bites then are without them, m. `moves_m_per_n` is
    /// the movement under 1 N of a disc with a relative inverse mass of 1. Slides the thread through its bites.
    pub(crate) fn solve(&mut self, moves_m_per_n: f64, places_m: &[DVec3], directions: &[DVec3]) -> Vec<DVec3> {
        let spans_m: Vec<DVec3> = places_m.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let TieKind::Thread { friction, .. } = self.tie.kind else {
            let yields = moves_m_per_n * self.discs.part_inverse_mass(0, 0) + self.compliance_m_per_n(0);
            return spans_m.first().map(|span_m| (*span_m - self.apart_m) / yields).into_iter().collect();
        };
        let parts = spans_m.len();
        let mut yields = vec![0.0; parts * parts];
        for one in 0..parts {
            for other in 0..parts {
                let along = directions[one].dot(directions[other]);
                yields[one * parts + other] = moves_m_per_n * along * self.discs.part_inverse_mass(one, other);
            }
            yields[one * parts + one] += self.compliance_m_per_n(one);
        }
        let gains: Vec<f64> = directions
            .windows(2)
            .map(|pair| {
                let cosine = pair[0].dot(pair[1]).clamp(-1.0, 1.0);
                if friction == 0.0 { 1.0 } else { libm::exp(friction * libm::acos(cosine)) }
            })
            .collect();
        let spans_m: Vec<f64> = spans_m.iter().zip(directions).map(|(span_m, along)| span_m.dot(*along)).collect();
        let mut tensions_n: Vec<f64> = self.forces_n.iter().map(|force_n| force_n.length()).collect();
        ThreadEquations { yields: &yields, spans_m: &spans_m, gains: &gains }
            .solve(&mut tensions_n, &mut self.lengths_m);
        tensions_n.iter().zip(directions).map(|(tension_n, along)| *tension_n * *along).collect()
    }

    fn saved(&self) -> SavedTie {
        SavedTie {
            number: self.number as u64,
            tie: SavedBites::of(&self.tie),
            lengths_m: self.lengths_m.clone(),
            apart_m: self.apart_m.into(),
            forces_n: self.forces_n.iter().map(|force_n| (*force_n).into()).collect(),
            tensions_n: self.tensions_n.clone(),
            peak_n: self.peak_n,
            is_broken: self.is_broken,
        }
    }

    fn restored(saved: &SavedTie, model: &Model, checks: &Checks<'_>) -> Result<Self> {
        let tie = saved.tie.restored(checks)?;
        check_tie("snapshot.tie", checks.shape, &tie, checks.limits)?;
        let parts = tie.bites.len() - 1;
        let lengths = if tie.kind == TieKind::Clip { 0 } else { parts };
        let counts = [saved.lengths_m.len() == lengths, saved.forces_n.len() == parts, saved.tensions_n.len() == parts];
        ensure(counts == [true; 3], "a thread with another number of parts than it has bites")?;
        let numbers = |values: &[f64]| -> Result<Vec<f64>> {
            values.iter().map(|value| checks.number(*value)).collect::<Result<_>>()
        };
        let (lengths_m, tensions_n) = (numbers(&saved.lengths_m)?, numbers(&saved.tensions_n)?);
        ensure(
            lengths_m.iter().chain(&tensions_n).all(|value| *value >= 0.0),
            "a thread of a negative length or tension",
        )?;
        let vectors = |values: &[Vector]| -> Result<Vec<DVec3>> {
            values.iter().map(|value| checks.vector(*value)).collect::<Result<_>>()
        };
        let forces_n = vectors(&saved.forces_n)?;
        let is_loose = forces_n.iter().all(|force_n| *force_n == DVec3::ZERO);
        ensure(is_loose || !saved.is_broken, "a broken thread that pulls")?;
        Ok(LaidTie {
            number: checks.tie(saved.number)?,
            discs: Arc::new(TiedDiscs::new(model, &tie.bites, None)),
            lengths_m,
            apart_m: checks.vector(saved.apart_m)?,
            forces_n,
            tensions_n,
            peak_n: checks.number(saved.peak_n)?,
            is_broken: saved.is_broken,
            tie,
        })
    }
}

/// Returns whether a thread has the length that it is to have, but for rounding.
fn is_about(now_m: f64, length_m: f64) -> bool {
    (now_m - length_m).abs() <= TOLERANCE * length_m
}

/// Returns the force on each disc of a tie, N, from those of its parts, which pull their first discs towards the second.
pub(crate) fn disc_forces_n(forces_n: &[DVec3]) -> Vec<DVec3> {
    let of = |disc: usize| {
        let ahead = forces_n.get(disc).copied().unwrap_or(DVec3::ZERO);
        let behind = disc.checked_sub(1).map_or(DVec3::ZERO, |part| forces_n[part]);
        ahead - behind
    };
    (0..=forces_n.len()).map(of).collect()
}

/// The equations of a thread: for each part, length + Σ yields·tension = span while it pulls, or tension 0 while it is loose.
struct ThreadEquations<'a> {
    /// By how much the span of each part becomes shorter under a tension of 1 N in each, row by row, m/N.
    yields: &'a [f64],
    /// The spans without tension, along the parts, m.
    spans_m: &'a [f64],
    /// The largest ratio of the tensions on both sides of each bite between two parts.
    gains: &'a [f64],
}

impl ThreadEquations<'_> {
    /// Solves for the tensions, N, from those before, and slides the thread through the bites: `lengths_m` are those of the parts.
    fn solve(&self, tensions_n: &mut [f64], lengths_m: &mut [f64]) {
        let parts = tensions_n.len();
        for sweep in 0..MAX_SWEEPS {
            let (mut changed_n, mut slid_m) = (0.0_f64, 0.0_f64);
            for number in 0..parts {
                // To and fro, so that what happens at one end reaches the other.
                let part = if sweep % 2 == 0 { number } else { parts - 1 - number };
                let tension_n = (self.left_m(part, tensions_n, lengths_m) / self.own(part)).max(0.0);
                changed_n = changed_n.max((tension_n - tensions_n[part]).abs());
                tensions_n[part] = tension_n;
                for bite in [part.checked_sub(1), (part + 1 < parts).then_some(part)].into_iter().flatten() {
                    slid_m = slid_m.max(self.slide(bite, tensions_n, lengths_m));
                }
            }
            let most_n = tensions_n.iter().copied().fold(0.0, f64::max);
            let longest_m = lengths_m.iter().copied().fold(0.0, f64::max);
            if changed_n <= TOLERANCE * most_n && slid_m <= TOLERANCE * longest_m {
                break;
            }
        }
    }

    fn own(&self, part: usize) -> f64 {
        self.yields[part * self.spans_m.len() + part]
    }

    /// Returns by how much a part would be too long without its own tension, m.
    fn left_m(&self, part: usize, tensions_n: &[f64], lengths_m: &[f64]) -> f64 {
        let row = &self.yields[part * tensions_n.len()..][..tensions_n.len()];
        let of =
            |(other, (yields, tension_n)): (usize, (&f64, &f64))| if other == part { 0.0 } else { yields * tension_n };
        self.spans_m[part] - lengths_m[part] - row.iter().zip(tensions_n).enumerate().map(of).sum::<f64>()
    }

    /// Slides the thread through the bite between part `bite` and the next until friction holds it. Returns by how much, m.
    fn slide(&self, bite: usize, tensions_n: &mut [f64], lengths_m: &mut [f64]) -> f64 {
        let gain = self.gains[bite];
        let [to, from] = if tensions_n[bite] > gain * tensions_n[bite + 1] {
            [bite, bite + 1]
        } else if tensions_n[bite + 1] > gain * tensions_n[bite] {
            [bite + 1, bite]
        } else {
            return 0.0;
        };
        let (tense_m, loose_m) = (self.left_m(to, tensions_n, lengths_m), self.left_m(from, tensions_n, lengths_m));
        let (of_tense, of_loose) = (self.own(to), self.own(from));
        // What hangs loose slides freely.
        let free_m = (-loose_m).max(0.0).min(tense_m.max(0.0));
        let (tense_n, loose_n) = ((tense_m - free_m) / of_tense, (loose_m + free_m) / of_loose);
        let pulled_m = if loose_m + free_m < 0.0 {
            0.0
        } else {
            (tense_n - gain * loose_n) / (of_tense.recip() + gain / of_loose)
        };
        let slid_m = (free_m + pulled_m).clamp(0.0, lengths_m[from]);
        lengths_m[to] += slid_m;
        lengths_m[from] -= slid_m;
        tensions_n[to] = ((tense_m - slid_m) / of_tense).max(0.0);
        tensions_n[from] = ((loose_m + slid_m) / of_loose).max(0.0);
        slid_m
    }
}
