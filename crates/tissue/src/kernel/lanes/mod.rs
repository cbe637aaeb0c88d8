//! Vectors of several widths, so that an algorithm is written once: AVX-512, AVX2 with FMA, NEON, and plain ones.
//!
//! Every operation is one that IEEE 754 rounds exactly, or moves bits. So an algorithm in which a lane's result depends
//! only on that lane's inputs has the same bits at every width.
//!
//! The processor must have the instructions. [`Width::of`] checks that, and a vector is the proof: `unsafe` functions
//! that require the instructions create the first vectors, and all others come from vectors.
#![allow(unsafe_code)]

use std::cell::Cell;

use crate::kernel::real::Real;
use crate::scene::Lanes;

/// A fixed number of values that are processed together.
pub(crate) trait Vector: Copy {
    type Real: Real;
    /// A set of lanes.
    type Mask: Copy;
    const LANES: usize;
    /// Whether the lanes form one register. If so, separate loops for the usual rows are worth their code size.
    const IS_REGISTER: bool = true;
    /// Whether [`Vector::pick`] is a few instructions.
    const PICKS: bool = false;

    /// # Safety
    /// The processor has the instructions, and `LANES` values can be read at `from`.
    unsafe fn load(from: *const Self::Real) -> Self;
    /// # Safety
    /// `LANES` values can be written at `to`.
    unsafe fn store(self, to: *mut Self::Real);
    /// Returns `value` in every lane.
    ///
    /// # Safety
    /// The processor has the instructions.
    unsafe fn of(value: Self::Real) -> Self;
    /// Returns `value` in every lane; `self` only proves that the processor has such vectors.
    #[inline(always)]
    fn splat(self, value: Self::Real) -> Self {
        // SAFETY: `self` is such a vector.
        unsafe { Self::of(value) }
    }
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn root(self) -> Self;
    /// Returns self·b + c, rounded once.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// Returns self·b − c, rounded once.
    fn mul_sub(self, b: Self, c: Self) -> Self;
    /// Returns self − a·b, rounded once.
    fn minus(self, a: Self, b: Self) -> Self;
    /// Returns 1/√self within 4 %, from half the exponent: the bits of a positive number are nearly its
    /// logarithm.
    fn approximate_inverse_root(self) -> Self;
    /// Returns 2^self, for integers from -100 to 100.
    fn power_of_two(self) -> Self;
    /// Returns `first`, `first` + 1, …; `self` is the proof.
    fn count(self, first: usize) -> Self;
    /// Returns the larger value; `other` if one is NaN.
    fn larger(self, other: Self) -> Self;
    /// Returns the smaller value; `other` if one is NaN.
    fn smaller(self, other: Self) -> Self;
    /// Returns the value of larger magnitude; either if one is NaN.
    fn farther(self, other: Self) -> Self;
    /// Returns the lanes where |self| > `bound`.
    fn beyond(self, bound: Self) -> Self::Mask;
    /// Returns the lanes where self > `bound`.
    fn above(self, bound: Self) -> Self::Mask;
    /// Returns the lanes where |self| is not below [`Real::MIN_MAGNITUDE`].
    fn counts(self) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Returns `a` where the mask is set, otherwise `b`.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// Returns the first `count` lanes; `self` is the proof.
    fn first(self, count: usize) -> Self::Mask;
    /// Returns the value with 0 where the mask is not set.
    fn keep(self, mask: Self::Mask) -> Self;
    /// Shifts each lane up by one; the last lane of `before` comes in.
    fn shift(self, before: Self) -> Self;
    /// Shifts each lane up by two; the last two lanes of `before` come in.
    fn shift_two(self, before: Self) -> Self;

    /// Returns x, y and z of records. `places` has their places, counted in values from `from`, one for each
    /// lane.
    ///
    /// # Safety
    /// The processor has the instructions; `LANES` places can be read, and the four values of each record.
    #[inline(always)]
    unsafe fn records(from: *const Self::Real, places: *const u32) -> [Self; 3] {
        let mut values = [[Self::Real::default(); MAX_LANES]; 3];
        // SAFETY: the caller's promise; no vector has more lanes.
        unsafe {
            for lane in 0..Self::LANES {
                let record = from.add(*places.add(lane) as usize);
                for (c, values) in values.iter_mut().enumerate() {
                    values[lane] = *record.add(c);
                }
            }
            [Self::load(values[0].as_ptr()), Self::load(values[1].as_ptr()), Self::load(values[2].as_ptr())]
        }
    }

    /// Writes x, y and z of `LANES` slots, the first of which is `slot`, to the records that begin at `to`
    /// ([`record_place`]). The fourth value of a record is not specified.
    ///
    /// # Safety
    /// `slot` is a multiple of `LANES`; there are records up to the end of its 16 slots.
    #[inline(always)]
    unsafe fn store_records(xyz: [Self; 3], to: *mut Self::Real, slot: usize) {
        let mut values = [[Self::Real::default(); MAX_LANES]; 3];
        // SAFETY: the caller's promise; no vector has more lanes.
        unsafe {
            for (vector, values) in xyz.into_iter().zip(&mut values) {
                vector.store(values.as_mut_ptr());
            }
            for lane in 0..Self::LANES {
                for (c, values) in values.iter().enumerate() {
                    *to.add(record_place(slot + lane) + c) = values[lane];
                }
            }
        }
    }

    /// Returns x, y and z of the records of every fourth lane and the one after it, which few vectors need. The
    /// other lanes are not specified, and their places not used.
    ///
    /// # Safety
    /// The processor has the instructions; `LANES` places can be read, and the four values of each record in
    /// use.
    #[inline(always)]
    unsafe fn half_of_records(from: *const Self::Real, places: *const u32) -> [Self; 3] {
        // SAFETY: the caller's promise.
        unsafe { Self::records(from, places) }
    }

    /// Returns, for each of N vectors, the lanes that `names` selects: of `own` below `LANES`, of `others[0]`
    /// below 2·`LANES`, and so on.
    ///
    /// # Safety
    /// The names can be read.
    #[inline(always)]
    unsafe fn pick<const N: usize, const G: usize>(
        names: *const Names,
        own: &[Self; N],
        others: &[[Self; N]; G],
    ) -> [Self; N] {
        let mut picked = *own;
        // SAFETY: the caller's promise; no vector has more lanes, and at most three others are used.
        unsafe {
            for n in 0..N {
                let (mut from, mut to) = ([Self::Real::default(); 4 * MAX_LANES], [Self::Real::default(); MAX_LANES]);
                own[n].store(from.as_mut_ptr());
                for (g, other) in others.iter().take(3).enumerate() {
                    other[n].store(from.as_mut_ptr().add((g + 1) * Self::LANES));
                }
                for (to, name) in to.iter_mut().zip((*names).lanes) {
                    *to = from[usize::from(name) % from.len()];
                }
                picked[n] = Self::load(to.as_ptr());
            }
        }
        picked
    }

    /// Returns the lanes that have a name ([`Names::of_some`]).
    ///
    /// # Safety
    /// The processor has the instructions, and the names can be read.
    #[inline(always)]
    unsafe fn named(names: *const Names) -> Self::Mask {
        let mut named = [Self::Real::default(); MAX_LANES];
        // SAFETY: the caller's promise; no vector has more lanes.
        unsafe {
            for (lane, named) in named.iter_mut().enumerate() {
                *named = Self::Real::of(f64::from((*names).mask >> lane & 1));
            }
            Self::load(named.as_ptr()).above(Self::of(Self::Real::default()))
        }
    }

    /// Prefetches the cache line at `at`, which need not exist.
    #[inline(always)]
    fn prefetch(_at: *const Self::Real) {}
}

/// For each lane of a vector, the number of a lane of one of several vectors ([`Vector::pick`]).
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub(crate) struct Names {
    lanes: [u8; MAX_LANES],
    /// Lanes that pick from the third vector or a later one; or, if some lanes have no name, those that have
    /// one.
    mask: u16,
}

impl Names {
    /// Creates names for vectors of `count` lanes.
    pub(crate) fn of(lanes: [u8; MAX_LANES], count: usize) -> Self {
        Names { lanes, mask: mask(|lane| usize::from(lanes[lane]) >= 2 * count) }
    }

    /// Returns the lane that `lane` picks.
    pub(crate) fn lane(&self, lane: usize) -> usize {
        usize::from(self.lanes[lane])
    }

    /// Creates names for some lanes.
    pub(crate) fn of_some(lanes: [Option<u8>; MAX_LANES]) -> Self {
        Names { lanes: lanes.map(Option::unwrap_or_default), mask: mask(|lane| lanes[lane].is_some()) }
    }
}

/// Returns the lanes for which `holds` is true, as bits.
fn mask(holds: impl Fn(usize) -> bool) -> u16 {
    (0..MAX_LANES).map(|lane| u16::from(holds(lane)) << lane).sum()
}

/// Number of lanes of the widest vector.
const MAX_LANES: usize = 16;

/// Returns where the record (x, y, z and one more value) of a slot begins, in values. Within 16 slots, records
/// are in the order in which registers hold them while they are transposed: those of slots 0, 4, 8 and 12, then
/// those of 1, 5, 9 and 13, …
#[inline(always)]
pub(crate) const fn record_place(slot: usize) -> usize {
    4 * (slot & !15 | (slot & 3) << 2 | slot >> 2 & 3)
}

/// A program that can run at any width.
pub(crate) trait Run<T> {
    /// # Safety
    /// The processor has the instructions of `V`, and the pointers of `self` are valid as documented.
    unsafe fn run<V: Vector<Real = T>>(&self);
}

/// Returns whether the processor has fused multiply-add, which every width needs. Calls of the C library that
/// emulate it would have the same bits, and take several times as long.
pub(crate) fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    let fuses = is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    let fuses = true;
    fuses
}

/// Returns the lanes that `auto` selects on this machine, or the requested ones if it has them. A machine without fused
/// multiply-add has none.
pub(crate) fn available(lanes: Lanes) -> Option<Lanes> {
    #[cfg(target_arch = "x86_64")]
    let (wide, narrow) = {
        // `range` needs AVX-512DQ.
        let wide = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq");
        (wide, is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"))
    };
    #[cfg(not(target_arch = "x86_64"))]
    let (wide, narrow) = (false, false);
    // A compile-time fact: every AArch64 processor has it.
    let neon = cfg!(target_arch = "aarch64");
    match lanes {
        Lanes::Auto if wide => Some(Lanes::Avx512),
        Lanes::Auto if narrow => Some(Lanes::Avx2),
        Lanes::Auto if neon => Some(Lanes::Neon),
        Lanes::Auto | Lanes::Plain => fuses().then_some(Lanes::Plain),
        Lanes::Avx512 => wide.then_some(Lanes::Avx512),
        Lanes::Avx2 => narrow.then_some(Lanes::Avx2),
        Lanes::Neon => neon.then_some(Lanes::Neon),
    }
}

/// Lanes that this machine supports.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Width(Lanes);

impl Width {
    /// Returns the requested lanes if this machine has them, otherwise those of `auto`.
    pub(crate) fn of(lanes: Lanes) -> Self {
        Width(available(lanes).or_else(|| available(Lanes::Auto)).unwrap_or(Lanes::Plain))
    }
}

/// The shape of a width's vectors for a number format: their lanes, and [`Vector::PICKS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LaneShape {
    pub(crate) lanes: usize,
    pub(crate) picks: bool,
}

impl LaneShape {
    pub(crate) const fn of<V: Vector>() -> Self {
        LaneShape { lanes: V::LANES, picks: V::PICKS }
    }
}

/// Returns the shape of a width's vectors of `T`.
pub(crate) fn shape<T: Real>(width: Width) -> LaneShape {
    struct ShapeProbe(Cell<LaneShape>);
    impl<T: Real> Run<T> for ShapeProbe {
        unsafe fn run<V: Vector<Real = T>>(&self) {
            self.0.set(LaneShape::of::<V>());
        }
    }
    let told = ShapeProbe(Cell::new(LaneShape::of::<Scalar<T>>()));
    // SAFETY: the program has no pointers.
    unsafe { run::<T>(width, &told) };
    told.0.get()
}

/// Runs `program` at a width.
///
/// # Safety
/// The pointers of `program` are valid as documented.
pub(crate) unsafe fn run<T: Real>(width: Width, program: &impl Run<T>) {
    // SAFETY: `Width::of` has checked the instructions; the rest is the caller's promise.
    unsafe {
        match width.0 {
            #[cfg(target_arch = "x86_64")]
            Lanes::Avx512 => x86::with_avx512(program),
            #[cfg(target_arch = "x86_64")]
            Lanes::Avx2 => x86::with_avx2(program),
            #[cfg(target_arch = "aarch64")]
            Lanes::Neon => program.run::<T::Neon>(),
            #[cfg(target_arch = "x86_64")]
            _ => {
                // `Width::of` has no alternative, and no tissue is created on a machine without the
                // instruction.
                assert!(fuses(), "the processor has no fused multiply-add");
                x86::with_fma(program);
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => program.run::<Pair<T>>(),
        }
    }
}

/// Work on single numbers. Mark [`SingleWork::compute`] and what it calls `#[inline(always)]`.
pub(crate) trait SingleWork {
    type Output: Default;
    fn compute(&self) -> Self::Output;
}

/// Does `work` with fused multiply-add as an instruction. Elsewhere each such operation calls the C library, which takes
/// longer, and on Windows (MinGW) rounds twice: then the bits differ.
pub(crate) fn single<W: SingleWork>(work: &W) -> W::Output {
    struct Single<'w, W: SingleWork>(&'w W, Cell<W::Output>);
    impl<W: SingleWork> Run<f64> for Single<'_, W> {
        #[inline(always)]
        unsafe fn run<V: Vector<Real = f64>>(&self) {
            self.1.set(self.0.compute());
        }
    }
    let single = Single(work, Cell::default());
    // SAFETY: the program has no pointers.
    unsafe { run(Width(Lanes::Plain), &single) };
    single.1.into_inner()
}

/// The operations that registers of every kind have under the same name.
// SAFETY (of every block): the processor has the instructions. The functions that create the first value require it,
// and every other function takes a value. Memory is the caller's promise.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! ordinary {
    ($name:ident, $real:ty, $mantissa:literal, $i:ident) => {
        #[inline(always)]
        unsafe fn load(from: *const $real) -> Self {
            unsafe { $name($i::load(from)) }
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut $real) {
            unsafe { $i::store(to, self.0) }
        }
        #[inline(always)]
        unsafe fn of(value: $real) -> Self {
            unsafe { $name($i::splat(value)) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            unsafe { $name($i::add(self.0, other.0)) }
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            unsafe { $name($i::sub(self.0, other.0)) }
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            unsafe { $name($i::mul(self.0, other.0)) }
        }
        #[inline(always)]
        fn div(self, other: Self) -> Self {
            unsafe { $name($i::div(self.0, other.0)) }
        }
        #[inline(always)]
        fn root(self) -> Self {
            unsafe { $name($i::root(self.0)) }
        }
        #[inline(always)]
        fn power_of_two(self) -> Self {
            // The last bits of the sum are the exponent.
            let sum = self.add(self.splat(<$real>::of(<$real as Real>::POWER)));
            unsafe { $name($i::real($i::left::<$mantissa>($i::bits(sum.0)))) }
        }
        #[inline(always)]
        #[allow(clippy::cast_precision_loss)]
        fn count(self, first: usize) -> Self {
            const COUNT: [$real; 16] =
                [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
            unsafe { $name($i::load(COUNT.as_ptr())).add(self.splat(first as $real)) }
        }
    };
}

mod plain;
pub(crate) use plain::{Pair, Scalar};

#[cfg(target_arch = "x86_64")]
mod x86;
#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{NarrowF32, NarrowF64, WideF32, WideF64};

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "aarch64")]
pub(crate) use neon::{NeonF32, NeonF64};

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Every operation on every lane, in one array.
    struct Everything<'a, T> {
        a: &'a [T; 16],
        b: &'a [T; 16],
        out: *mut T,
    }

    /// Records written, read in another order, and picked.
    struct Records<'a, T> {
        xyz: &'a [[T; 16]; 3],
        out: *mut T,
    }

    impl<T: Real> Run<T> for Records<'_, T> {
        #[inline(always)]
        unsafe fn run<V: Vector<Real = T>>(&self) {
            let places: [u32; 16] = std::array::from_fn(|lane| record_place(lane * 7 % 16) as u32);
            let mut records = [T::default(); 64];
            unsafe {
                for slot in (0..16).step_by(V::LANES) {
                    let xyz = self.xyz.each_ref().map(|values| V::load(values.as_ptr().add(slot)));
                    V::store_records(xyz, records.as_mut_ptr(), slot);
                }
                for slot in (0..16).step_by(V::LANES) {
                    let read = V::records(records.as_ptr(), places.as_ptr().add(slot));
                    for (c, read) in read.into_iter().enumerate() {
                        read.store(self.out.add(16 * c + slot));
                    }
                    let read = V::half_of_records(records.as_ptr(), places.as_ptr().add(slot));
                    for (c, read) in read.into_iter().enumerate() {
                        read.store(self.out.add(48 + 16 * c + slot));
                    }
                }
            }
        }
    }

    fn records_are_read_where_they_were_written<T: Real>() {
        let xyz: [[T; 16]; 3] = std::array::from_fn(|c| std::array::from_fn(|slot| T::of((100 * c + slot) as f64)));
        for lanes in [Lanes::Plain, Lanes::Avx2, Lanes::Avx512, Lanes::Neon] {
            let mut out = [T::default(); 96];
            unsafe { run(Width::of(lanes), &Records { xyz: &xyz, out: out.as_mut_ptr() }) };
            for (at, value) in out.into_iter().enumerate() {
                let is_read = at < 48 || at % 4 < 2;
                assert!(!is_read || value == xyz[at % 48 / 16][at % 16 * 7 % 16], "{lanes:?} {at}");
            }
        }
    }

    #[test]
    fn a_record_holds_the_three_components_of_a_slot() {
        records_are_read_where_they_were_written::<f32>();
        records_are_read_where_they_were_written::<f64>();
        let mut places: Vec<usize> = (0..48).map(record_place).collect();
        places.sort_unstable();
        assert!(places.into_iter().eq((0..48).map(|slot| 4 * slot)));
    }

    /// The values that each lane picks from one to four vectors, and those of the lanes with a name.
    struct Picks<'a, T> {
        from: &'a [T],
        names: Names,
        some: Names,
        out: *mut T,
    }

    impl<T: Real> Run<T> for Picks<'_, T> {
        #[inline(always)]
        unsafe fn run<V: Vector<Real = T>>(&self) {
            unsafe {
                let all: [[V; 1]; 4] = std::array::from_fn(|n| [V::load(self.from.as_ptr().add(n * V::LANES))]);
                let (names, some): (*const Names, *const Names) = (&raw const self.names, &raw const self.some);
                let picked = [
                    V::pick::<1, 0>(some, &all[0], &[])[0].keep(V::named(some)),
                    V::pick::<1, 1>(names, &all[0], &[all[1]])[0],
                    V::pick::<1, 2>(names, &all[0], &[all[1], all[2]])[0],
                    V::pick::<1, 3>(names, &all[0], &[all[1], all[2], all[3]])[0],
                ];
                for (n, picked) in picked.into_iter().enumerate() {
                    picked.store(self.out.add(16 * n));
                }
            }
        }
    }

    #[test]
    fn a_lane_picks_the_lane_that_it_names() {
        let from: Vec<f32> = (0..64).map(|n| n as f32 + 1.0).collect();
        for lanes in [Lanes::Plain, Lanes::Avx2, Lanes::Avx512, Lanes::Neon] {
            let width = Width::of(lanes);
            let LaneShape { lanes: count, .. } = shape::<f32>(width);
            for vectors in 2..=4 {
                let named: [u8; 16] = std::array::from_fn(|lane| (lane * 11 % (vectors * count)) as u8);
                let some = named.map(|name| (usize::from(name) < count).then_some(name));
                let mut out = [0.0; 64];
                let (names, some_names) = (Names::of(named, count), Names::of_some(some));
                unsafe { run(width, &Picks { from: &from, names, some: some_names, out: out.as_mut_ptr() }) };
                for lane in 0..count {
                    let truth = from[usize::from(named[lane])];
                    assert_eq!(out[16 * (vectors - 1) + lane], truth, "{lanes:?} {vectors} {lane}");
                    assert_eq!(out[lane], if some[lane].is_some() { truth } else { 0.0 }, "{lanes:?} {lane}");
                }
            }
        }
    }

    impl<T: Real> Run<T> for Everything<'_, T> {
        #[inline(always)]
        unsafe fn run<V: Vector<Real = T>>(&self) {
            unsafe {
                let mut before = V::of(T::of(7.0));
                for at in (0..16).step_by(V::LANES) {
                    let (a, b) = (V::load(self.a.as_ptr().add(at)), V::load(self.b.as_ptr().add(at)));
                    let mask = a.first(11_usize.saturating_sub(at));
                    let far = V::either(a.beyond(a.splat(T::of(2.5))), b.beyond(a.splat(T::of(100.0))));
                    let results = [
                        a.add(b),
                        a.sub(b),
                        a.mul(b),
                        a.div(b),
                        a.mul(a).root(),
                        a.mul_add(b, a),
                        a.mul_sub(b, b),
                        a.larger(b),
                        a.smaller(b),
                        a.farther(b),
                        V::select(far, a, b),
                        a.keep(mask),
                        a.shift(before),
                        a.shift_two(before),
                        a.minus(a, b),
                        b.mul(b).approximate_inverse_root(),
                        a.count(at).sub(a.splat(T::of(9.0))).power_of_two(),
                        a.keep(a.mul(a.splat(T::of(T::MIN_MAGNITUDE))).counts()),
                        a.keep(V::both(a.above(b), mask)),
                        if V::any(mask) { a } else { b },
                    ];
                    before = a;
                    for (n, result) in results.into_iter().enumerate() {
                        // Whether any lane is set depends on the width by definition.
                        if n < 18 {
                            result.store(self.out.add(16 * n + at));
                        }
                    }
                }
            }
        }
    }

    fn same_at_every_width<T: Real>() {
        let a: [T; 16] = std::array::from_fn(|i| T::of(0.37 * i as f64 * if i % 3 == 0 { -1.0 } else { 1.1 }));
        let b: [T; 16] = std::array::from_fn(|i| T::of(13.0 / (1.0 + i as f64) - 2.0));
        let result = |lanes| {
            let mut out = vec![T::default(); 18 * 16];
            unsafe { run(Width::of(lanes), &Everything { a: &a, b: &b, out: out.as_mut_ptr() }) };
            out.into_iter().map(Real::wide).collect::<Vec<_>>()
        };
        let plain = result(Lanes::Plain);
        assert!(plain.iter().any(|v| *v != 0.0));
        for lanes in [Lanes::Avx2, Lanes::Avx512, Lanes::Neon] {
            if available(lanes).is_some() {
                assert_eq!(result(lanes), plain, "{lanes:?}");
            }
        }
    }

    #[test]
    fn every_operation_has_the_same_bits_at_every_width() {
        same_at_every_width::<f32>();
        same_at_every_width::<f64>();
    }
}
