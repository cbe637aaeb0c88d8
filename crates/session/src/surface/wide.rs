//! Vectors of sixteen numbers, with AVX-512, AVX2 or plain instructions, chosen at run time.
//!
//! Every operation is one that IEEE 754 rounds exactly, or moves bits, so results are equal at every width. Code
//! that the compiler does not inline into the function of a width loses that width's instructions: hot code is
//! `#[inline(always)]` and uses neither iterators nor closures over lanes. This is the only file of the folder with
//! unsafe code: the processor must have each instruction, which [`Width::run`] ensures.
#![allow(unsafe_code)]
#![allow(clippy::needless_range_loop)]

use std::marker::PhantomData;

/// Number of lanes.
pub(super) const LANES: usize = 16;

/// Sixteen numbers. A value proves that the processor has the instructions: unsafe functions create the first ones
/// through an [`Available`], and all others come from values.
pub(super) trait SixteenLanes: Copy {
    /// # Safety
    /// The processor has the instructions.
    unsafe fn load(from: &[f32; LANES]) -> Self;
    /// # Safety
    /// The processor has the instructions.
    unsafe fn splat(value: f32) -> Self;
    fn store(self, to: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    /// Returns the smaller number of each lane; `other` if one is NaN.
    fn smaller(self, other: Self) -> Self;
    /// Returns the larger number of each lane; `other` if one is NaN.
    fn larger(self, other: Self) -> Self;
    /// Stores x, y and z of sixteen points as x0 y0 z0 x1 …
    fn weave(xyz: [Self; 3], to: &mut [[f32; LANES]; 3]);
    /// Stores x, y and z of sixteen points as x0 y0 z0 x1 …, each rounded as [`SixteenLanes::store_rounded`] does.
    fn weave_rounded(xyz: [Self; 3], to: &mut [[[u8; 2]; LANES]; 3]);
    /// Returns a vector whose lane l is lane `from[l]` of this one; the indices are below 16.
    fn permute(self, from: &[i32; LANES]) -> Self;
    /// Stores the nearest integers, little-endian, of values within ±32767.
    fn store_rounded(self, to: &mut [[u8; 2]; LANES]);
}

/// Proof that the processor has the instructions of `L`. Only this file creates one.
pub(super) struct Available<L>(PhantomData<L>);

impl<L> Clone for Available<L> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<L> Copy for Available<L> {}

impl Available<Plain> {
    /// Every processor has the plain instructions.
    pub(super) const PLAIN: Self = Available(PhantomData);
}

impl<L: SixteenLanes> Available<L> {
    /// # Safety
    /// The processor has the instructions.
    #[cfg(target_arch = "x86_64")]
    unsafe fn new() -> Self {
        Available(PhantomData)
    }

    /// Loads sixteen numbers.
    #[inline(always)]
    pub(super) fn load(self, from: &[f32; LANES]) -> L {
        // SAFETY: the creator of this value promised the instructions.
        unsafe { L::load(from) }
    }

    /// Returns a vector with `value` in every lane.
    #[inline(always)]
    pub(super) fn splat(self, value: f32) -> L {
        // SAFETY: the creator of this value promised the instructions.
        unsafe { L::splat(value) }
    }
}

/// A computation that can run at any width.
pub(super) trait WideWork {
    /// Runs it; implementations must be `#[inline(always)]`.
    fn work<L: SixteenLanes>(self, with: Available<L>);
}

/// An instruction set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Width {
    Plain,
    Avx2,
    Avx512,
}

impl Width {
    pub(super) const ALL: [Width; 3] = [Width::Plain, Width::Avx2, Width::Avx512];

    #[cfg(target_arch = "x86_64")]
    pub(super) fn is_available(self) -> bool {
        match self {
            Width::Plain => true,
            Width::Avx2 => is_x86_feature_detected!("avx2"),
            Width::Avx512 => is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512bw"),
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    pub(super) fn is_available(self) -> bool {
        self == Width::Plain
    }

    /// Returns the widest instruction set that this machine has.
    pub(super) fn widest() -> Width {
        Width::ALL.into_iter().rfind(|width| width.is_available()).unwrap_or(Width::Plain)
    }

    /// Runs `work` with these instructions, or with plain ones if they are not available.
    pub(super) fn run(self, work: impl WideWork) {
        match self {
            // SAFETY: the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            Width::Avx512 if self.is_available() => unsafe { x86::with_avx512(work) },
            // SAFETY: the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            Width::Avx2 if self.is_available() => unsafe { x86::with_avx2(work) },
            _ => work.work(Available::PLAIN),
        }
    }
}

#[derive(Clone, Copy)]
pub(super) struct Plain([f32; LANES]);

/// Computes each lane.
macro_rules! each {
    (|$lane:ident| $body:expr) => {{
        let mut out = [0.0; LANES];
        for $lane in 0..LANES {
            out[$lane] = $body;
        }
        Plain(out)
    }};
}

impl SixteenLanes for Plain {
    #[inline(always)]
    unsafe fn load(from: &[f32; LANES]) -> Self {
        Plain(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        *to = self.0;
    }
    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Plain([value; LANES])
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        each!(|lane| self.0[lane] + other.0[lane])
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        each!(|lane| self.0[lane] - other.0[lane])
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        each!(|lane| self.0[lane] * other.0[lane])
    }
    #[inline(always)]
    fn smaller(self, other: Self) -> Self {
        each!(|lane| if self.0[lane] < other.0[lane] { self.0[lane] } else { other.0[lane] })
    }
    #[inline(always)]
    fn larger(self, other: Self) -> Self {
        each!(|lane| if self.0[lane] > other.0[lane] { self.0[lane] } else { other.0[lane] })
    }
    #[inline(always)]
    fn weave(xyz: [Self; 3], to: &mut [[f32; LANES]; 3]) {
        for lane in 0..3 * LANES {
            to[lane / LANES][lane % LANES] = xyz[lane % 3].0[lane / 3];
        }
    }
    #[inline(always)]
    fn weave_rounded(xyz: [Self; 3], to: &mut [[[u8; 2]; LANES]; 3]) {
        let mut woven = [[0.0; LANES]; 3];
        Self::weave(xyz, &mut woven);
        for part in 0..3 {
            Plain(woven[part]).store_rounded(&mut to[part]);
        }
    }
    #[inline(always)]
    #[allow(clippy::cast_sign_loss)]
    fn permute(self, from: &[i32; LANES]) -> Self {
        each!(|lane| self.0[from[lane] as usize % LANES])
    }
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation)]
    fn store_rounded(self, to: &mut [[u8; 2]; LANES]) {
        // 1.5·2²³ + v has no bits left for the fraction, and its last 16 are those of the integer.
        const MAGIC: f32 = 12_582_912.0;
        for lane in 0..LANES {
            to[lane] = ((self.0[lane] + MAGIC).to_bits() as u16).to_le_bytes();
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Available, LANES, SixteenLanes, WideWork};

    /// # Safety
    /// The processor has these instructions.
    #[target_feature(enable = "avx512f,avx512bw")]
    pub(super) unsafe fn with_avx512(work: impl WideWork) {
        // SAFETY: the caller's promise.
        work.work(unsafe { Available::<Wide>::new() });
    }

    /// # Safety
    /// The processor has these instructions.
    #[target_feature(enable = "avx2")]
    pub(super) unsafe fn with_avx2(work: impl WideWork) {
        // SAFETY: the caller's promise.
        work.work(unsafe { Available::<Narrow>::new() });
    }

    /// Returns, for each lane of a result, the source lane of component `c` when three vectors are interleaved. In
    /// each of the three results the component takes other lanes, so one permutation is enough.
    const fn sources<const N: usize>(c: usize) -> [i32; N] {
        let mut sources = [0; N];
        let mut place = c;
        while place < 3 * N {
            #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
            (sources[place % N] = (place / 3) as i32);
            place += 3;
        }
        sources
    }

    #[derive(Clone, Copy)]
    struct Wide(__m512);

    // SAFETY (of every block below): a value of these types, or the caller's promise, is the proof that the processor
    // has the instructions; memory is an array of that many numbers.
    impl SixteenLanes for Wide {
        #[inline(always)]
        unsafe fn load(from: &[f32; LANES]) -> Self {
            unsafe { Wide(_mm512_loadu_ps(from.as_ptr())) }
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; LANES]) {
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            unsafe { Wide(_mm512_set1_ps(value)) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            unsafe { Wide(_mm512_add_ps(self.0, other.0)) }
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            unsafe { Wide(_mm512_sub_ps(self.0, other.0)) }
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            unsafe { Wide(_mm512_mul_ps(self.0, other.0)) }
        }
        #[inline(always)]
        fn smaller(self, other: Self) -> Self {
            unsafe { Wide(_mm512_min_ps(self.0, other.0)) }
        }
        #[inline(always)]
        fn larger(self, other: Self) -> Self {
            unsafe { Wide(_mm512_max_ps(self.0, other.0)) }
        }
        #[inline(always)]
        fn weave([x, y, z]: [Self; 3], to: &mut [[f32; LANES]; 3]) {
            const X: [i32; LANES] = sources(0);
            const Y: [i32; LANES] = sources(1);
            const Z: [i32; LANES] = sources(2);
            // Lanes n, n + 3, …
            const FIRST: u16 = 0x9249;
            const SECOND: u16 = 0x2492;
            const THIRD: u16 = 0x4924;
            let (x, y, z) = (x.permute(&X).0, y.permute(&Y).0, z.permute(&Z).0);
            unsafe {
                Wide(_mm512_mask_mov_ps(_mm512_mask_mov_ps(x, SECOND, y), THIRD, z)).store(&mut to[0]);
                Wide(_mm512_mask_mov_ps(_mm512_mask_mov_ps(x, FIRST, y), SECOND, z)).store(&mut to[1]);
                Wide(_mm512_mask_mov_ps(_mm512_mask_mov_ps(x, THIRD, y), FIRST, z)).store(&mut to[2]);
            }
        }
        #[inline(always)]
        fn weave_rounded([x, y, z]: [Self; 3], to: &mut [[[u8; 2]; LANES]; 3]) {
            // x and y of a point are words 2n and 2n + 1 of the first operand, z is word 2n of the second.
            const WORDS: [i16; 6 * LANES] = {
                let mut words = [0; 6 * LANES];
                let mut word = 0;
                while word < 3 * LANES {
                    let (point, c) = ((word / 3) as i16, (word % 3) as i16);
                    words[word] = if c < 2 { 2 * point + c } else { 2 * LANES as i16 + 2 * point };
                    word += 1;
                }
                words
            };
            unsafe {
                let (x, y, z) = (_mm512_cvtps_epi32(x.0), _mm512_cvtps_epi32(y.0), _mm512_cvtps_epi32(z.0));
                let xy = _mm512_mask_blend_epi16(0xaaaa_aaaa, x, _mm512_slli_epi32::<16>(y));
                let from = WORDS.as_ptr();
                let words = _mm512_permutex2var_epi16(xy, _mm512_loadu_si512(from.cast()), z);
                let rest = _mm512_permutex2var_epi16(xy, _mm512_loadu_si512(from.add(2 * LANES).cast()), z);
                let to = to.as_mut_ptr();
                _mm512_storeu_si512(to.cast(), words);
                _mm256_storeu_si256(to.add(2).cast(), _mm512_castsi512_si256(rest));
            }
        }
        #[inline(always)]
        fn permute(self, from: &[i32; LANES]) -> Self {
            unsafe { Wide(_mm512_permutexvar_ps(_mm512_loadu_si512(from.as_ptr().cast()), self.0)) }
        }
        #[inline(always)]
        fn store_rounded(self, to: &mut [[u8; 2]; LANES]) {
            unsafe {
                const LOW_WORDS: [i16; 2 * LANES] = {
                    let mut words = [0; 2 * LANES];
                    let mut lane = 0;
                    while lane < LANES {
                        words[lane] = 2 * lane as i16;
                        lane += 1;
                    }
                    words
                };
                let words = _mm512_loadu_si512(LOW_WORDS.as_ptr().cast());
                let rounded = _mm512_permutexvar_epi16(words, _mm512_cvtps_epi32(self.0));
                _mm256_storeu_si256(to.as_mut_ptr().cast(), _mm512_castsi512_si256(rounded));
            }
        }
    }

    #[derive(Clone, Copy)]
    struct Narrow([__m256; 2]);

    impl Narrow {
        /// Interleaves eight points.
        #[inline(always)]
        fn weave_half(x: __m256, y: __m256, z: __m256) -> [__m256; 3] {
            const X: [i32; 8] = sources(0);
            const Y: [i32; 8] = sources(1);
            const Z: [i32; 8] = sources(2);
            // Lanes n, n + 3, …, of eight.
            const FIRST: i32 = 0x49;
            const SECOND: i32 = 0x92;
            const THIRD: i32 = 0x24;
            unsafe {
                let x = _mm256_permutevar8x32_ps(x, _mm256_loadu_si256(X.as_ptr().cast()));
                let y = _mm256_permutevar8x32_ps(y, _mm256_loadu_si256(Y.as_ptr().cast()));
                let z = _mm256_permutevar8x32_ps(z, _mm256_loadu_si256(Z.as_ptr().cast()));
                [
                    _mm256_blend_ps::<THIRD>(_mm256_blend_ps::<SECOND>(x, y), z),
                    _mm256_blend_ps::<FIRST>(_mm256_blend_ps::<THIRD>(x, y), z),
                    _mm256_blend_ps::<SECOND>(_mm256_blend_ps::<FIRST>(x, y), z),
                ]
            }
        }

        #[inline(always)]
        fn woven([x, y, z]: [Self; 3]) -> [Self; 3] {
            let [a, b, c] = Narrow::weave_half(x.0[0], y.0[0], z.0[0]);
            let [d, e, f] = Narrow::weave_half(x.0[1], y.0[1], z.0[1]);
            [Narrow([a, b]), Narrow([c, d]), Narrow([e, f])]
        }

        /// Returns eight permuted lanes of sixteen.
        #[inline(always)]
        fn permute_half(self, from: __m256i) -> __m256 {
            unsafe {
                let low = _mm256_permutevar8x32_ps(self.0[0], from);
                let high = _mm256_permutevar8x32_ps(self.0[1], from);
                // Bit 3 of the index selects the half, as the sign.
                _mm256_blendv_ps(low, high, _mm256_castsi256_ps(_mm256_slli_epi32::<28>(from)))
            }
        }
    }

    /// Applies an operation to each half.
    macro_rules! halves {
        ($operation:ident, $a:ident, $b:ident) => {
            unsafe { Narrow([$operation($a.0[0], $b.0[0]), $operation($a.0[1], $b.0[1])]) }
        };
    }

    impl SixteenLanes for Narrow {
        #[inline(always)]
        unsafe fn load(from: &[f32; LANES]) -> Self {
            unsafe { Narrow([_mm256_loadu_ps(from.as_ptr()), _mm256_loadu_ps(from.as_ptr().add(8))]) }
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; LANES]) {
            unsafe {
                _mm256_storeu_ps(to.as_mut_ptr(), self.0[0]);
                _mm256_storeu_ps(to.as_mut_ptr().add(8), self.0[1]);
            }
        }
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            unsafe { Narrow([_mm256_set1_ps(value); 2]) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            halves!(_mm256_add_ps, self, other)
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            halves!(_mm256_sub_ps, self, other)
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            halves!(_mm256_mul_ps, self, other)
        }
        #[inline(always)]
        fn smaller(self, other: Self) -> Self {
            halves!(_mm256_min_ps, self, other)
        }
        #[inline(always)]
        fn larger(self, other: Self) -> Self {
            halves!(_mm256_max_ps, self, other)
        }
        #[inline(always)]
        fn weave(xyz: [Self; 3], to: &mut [[f32; LANES]; 3]) {
            let [a, b, c] = Narrow::woven(xyz);
            a.store(&mut to[0]);
            b.store(&mut to[1]);
            c.store(&mut to[2]);
        }
        #[inline(always)]
        fn weave_rounded(xyz: [Self; 3], to: &mut [[[u8; 2]; LANES]; 3]) {
            let [a, b, c] = Narrow::woven(xyz);
            a.store_rounded(&mut to[0]);
            b.store_rounded(&mut to[1]);
            c.store_rounded(&mut to[2]);
        }
        #[inline(always)]
        fn permute(self, from: &[i32; LANES]) -> Self {
            unsafe {
                let low = _mm256_loadu_si256(from.as_ptr().cast());
                let high = _mm256_loadu_si256(from.as_ptr().add(8).cast());
                Narrow([self.permute_half(low), self.permute_half(high)])
            }
        }
        #[inline(always)]
        fn store_rounded(self, to: &mut [[u8; 2]; LANES]) {
            unsafe {
                let packed = _mm256_packs_epi32(_mm256_cvtps_epi32(self.0[0]), _mm256_cvtps_epi32(self.0[1]));
                // The instruction packs each half separately.
                _mm256_storeu_si256(to.as_mut_ptr().cast(), _mm256_permute4x64_epi64::<0b11_01_10_00>(packed));
            }
        }
    }
}
