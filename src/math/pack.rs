//! Packs of numbers: one per lane of the machine's vector registers, with arithmetic in all lanes at once.
//!
//! Kernels are written once over `Pack<S>` and run on AVX-512, AVX2, NEON or plain numbers, chosen at run time by `dispatch`.
//! Loops and functions rather than closures and `map` throughout: what is not inlined loses the processor's features.
//! Products and sums are fused where written so; instruction sets without fused ones differ in rounding.

#![expect(clippy::needless_range_loop, reason = "lanes read best by their numbers")]

use pulp::Simd;
pub use pulp::{Arch, WithSimd};
use std::{
    cell::Cell,
    ops::{Add, Mul, Neg, Sub},
};

/// Elements of a batch: the lanes of the widest machine; narrower ones take several turns.
pub const WIDTH: usize = 8;

/// One number per lane.
#[derive(Clone, Copy)]
pub struct Pack<S: Simd> {
    simd: S,
    lanes: S::f64s,
}

/// A vector per lane.
pub type Pack3<S> = [Pack<S>; 3];

thread_local! {
    static CHOSEN: Cell<Option<Arch>> = const { Cell::new(None) };
}

/// The instructions that this thread's kernels run on: the best of this machine, unless `with_instructions` chose others.
#[inline]
pub fn instructions() -> Arch {
    CHOSEN.get().unwrap_or_default()
}

/// Every instruction set that this machine can run, plain numbers first.
pub fn all_instructions() -> Vec<Arch> {
    let mut all = vec![Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        all.extend(pulp::x86::V3::try_new().map(Arch::V3));
        all.extend(pulp::x86::V4::try_new().map(Arch::V4));
    }
    if all.len() == 1 && !matches!(Arch::new(), Arch::Scalar) {
        all.push(Arch::new());
    }
    all
}

/// Runs work whose kernels, on this thread, use instructions that are not the best ones: to compare results.
pub fn with_instructions<T>(arch: Arch, work: impl FnOnce() -> T) -> T {
    let before = CHOSEN.replace(Some(arch));
    let result = work();
    CHOSEN.set(before);
    result
}

/// Runs a kernel with the thread's instructions.
#[inline]
pub fn dispatch<K: WithSimd>(kernel: K) -> K::Output {
    instructions().dispatch(kernel)
}

/// Some of the lanes of a pack.
#[derive(Clone, Copy)]
pub struct Mask<S: Simd> {
    lanes: S::m64s,
    simd: S,
}

impl<S: Simd> Mask<S> {
    /// Whether there are none.
    #[inline(always)]
    pub fn is_empty(self) -> bool {
        // Which one is the first is not the same for all instruction sets (pulp 0.22).
        self.simd.first_true_m64s(self.lanes) >= S::F64_LANES
    }

    /// Those that are among others too.
    #[inline(always)]
    pub fn and(self, others: Self) -> Self {
        Mask { lanes: self.simd.and_m64s(self.lanes, others.lanes), ..self }
    }

    /// `own` in these, `other` in the others.
    #[inline(always)]
    pub fn select(self, own: Pack<S>, other: Pack<S>) -> Pack<S> {
        Pack { lanes: self.simd.select_f64s(self.lanes, own.lanes, other.lanes), ..own }
    }
}

impl<S: Simd> Pack<S> {
    /// The same number in every lane.
    #[inline(always)]
    pub fn splat(simd: S, value: f64) -> Self {
        Pack { simd, lanes: simd.splat_f64s(value) }
    }

    /// The lanes of a batch that begin at lane `from`.
    #[inline(always)]
    pub fn load(simd: S, batch: &[f64; WIDTH], from: usize) -> Self {
        Pack { simd, lanes: S::as_simd_f64s(&batch[from..from + S::F64_LANES]).0[0] }
    }

    /// Stores into the lanes of a batch that begin at lane `from`.
    #[inline(always)]
    pub fn store(self, batch: &mut [f64; WIDTH], from: usize) {
        S::as_mut_simd_f64s(&mut batch[from..from + S::F64_LANES]).0[0] = self.lanes;
    }

    /// The numbers of a list from `at` on.
    #[inline(always)]
    pub fn load_at(simd: S, list: &[f64], at: usize) -> Self {
        Pack { simd, lanes: S::as_simd_f64s(&list[at..at + S::F64_LANES]).0[0] }
    }

    /// The numbers of a list that is shorter than the lanes, and zeros.
    #[inline(always)]
    pub fn load_part(simd: S, list: &[f64]) -> Self {
        Pack { simd, lanes: simd.partial_load_f64s(list) }
    }

    /// Stores into a list from `at` on.
    #[inline(always)]
    pub fn store_at(self, list: &mut [f64], at: usize) {
        S::as_mut_simd_f64s(&mut list[at..at + S::F64_LANES]).0[0] = self.lanes;
    }

    /// Adds to the numbers of a list from `at` on.
    #[inline(always)]
    pub fn add_to(self, list: &mut [f64], at: usize) {
        let place = &mut S::as_mut_simd_f64s(&mut list[at..at + S::F64_LANES]).0[0];
        *place = self.simd.add_f64s(*place, self.lanes);
    }

    /// The numbers that lie from a place on.
    ///
    /// # Safety
    /// As many numbers as lanes lie there, and nobody writes them meanwhile.
    #[inline(always)]
    pub unsafe fn load_from(simd: S, place: *const f64) -> Self {
        // SAFETY: as the caller says; registers may lie anywhere.
        Pack { simd, lanes: unsafe { place.cast::<S::f64s>().read_unaligned() } }
    }

    /// Adds to the numbers that lie from a place on.
    ///
    /// # Safety
    /// As many numbers as lanes lie there, and nobody else reads or writes them meanwhile.
    #[inline(always)]
    pub unsafe fn add_at(self, place: *mut f64) {
        // SAFETY: as the caller says; registers may lie anywhere.
        unsafe {
            let place = place.cast::<S::f64s>();
            place.write_unaligned(self.simd.add_f64s(place.read_unaligned(), self.lanes));
        }
    }

    /// Applies a scalar function lane by lane, for what the machine has no instruction for.
    #[inline(always)]
    pub fn map(self, function: fn(f64) -> f64) -> Self {
        let mut batch = [0.0; WIDTH];
        self.store(&mut batch, 0);
        for lane in 0..S::F64_LANES {
            batch[lane] = function(batch[lane]);
        }
        Pack::load(self.simd, &batch, 0)
    }

    /// The same number in every lane, beside this pack.
    #[inline(always)]
    pub fn like(self, value: f64) -> Self {
        Pack::splat(self.simd, value)
    }

    /// self · b + c, rounded once where the machine can.
    #[inline(always)]
    pub fn mul_add(self, b: Self, c: Self) -> Self {
        Pack { lanes: self.simd.mul_add_f64s(self.lanes, b.lanes, c.lanes), ..self }
    }

    /// Square root.
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Pack { lanes: self.simd.sqrt_f64s(self.lanes), ..self }
    }

    /// 1/self.
    #[inline(always)]
    pub fn inverse(self) -> Self {
        Pack { lanes: self.simd.div_f64s(self.simd.splat_f64s(1.0), self.lanes), ..self }
    }

    /// Absolute value.
    #[inline(always)]
    pub fn abs(self) -> Self {
        Pack { lanes: self.simd.abs_f64s(self.lanes), ..self }
    }

    /// The larger of both, `other` where one is not a number.
    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        other.select_less(self, self, other)
    }

    /// Lanes that are smaller than others.
    #[inline(always)]
    pub fn less(self, bound: Self) -> Mask<S> {
        Mask { lanes: self.simd.less_than_f64s(self.lanes, bound.lanes), simd: self.simd }
    }

    /// Lanes below `from`, or at `to` or above.
    #[inline(always)]
    pub fn outside(self, [from, to]: [f64; 2]) -> Mask<S> {
        let below = self.simd.less_than_f64s(self.lanes, self.simd.splat_f64s(from));
        let above = self.simd.less_than_or_equal_f64s(self.simd.splat_f64s(to), self.lanes);
        Mask { lanes: self.simd.or_m64s(below, above), simd: self.simd }
    }

    /// `if_less` where self < bound, else `otherwise`.
    #[inline(always)]
    pub fn select_less(self, bound: Self, if_less: Self, otherwise: Self) -> Self {
        let mask = self.simd.less_than_f64s(self.lanes, bound.lanes);
        Pack { lanes: self.simd.select_f64s(mask, if_less.lanes, otherwise.lanes), ..self }
    }
}

impl<S: Simd> Add for Pack<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Pack { lanes: self.simd.add_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Sub for Pack<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Pack { lanes: self.simd.sub_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Mul for Pack<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Pack { lanes: self.simd.mul_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Neg for Pack<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.like(0.0) - self
    }
}

/// a + b
#[inline(always)]
pub fn add<S: Simd>(a: Pack3<S>, b: Pack3<S>) -> Pack3<S> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// a − b
#[inline(always)]
pub fn sub<S: Simd>(a: Pack3<S>, b: Pack3<S>) -> Pack3<S> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// −a
#[inline(always)]
pub fn neg<S: Simd>(a: Pack3<S>) -> Pack3<S> {
    [-a[0], -a[1], -a[2]]
}

/// a · factor
#[inline(always)]
pub fn scale<S: Simd>(a: Pack3<S>, factor: Pack<S>) -> Pack3<S> {
    [a[0] * factor, a[1] * factor, a[2] * factor]
}

/// a · factor + b
#[inline(always)]
pub fn axpy<S: Simd>(a: Pack3<S>, factor: Pack<S>, b: Pack3<S>) -> Pack3<S> {
    [a[0].mul_add(factor, b[0]), a[1].mul_add(factor, b[1]), a[2].mul_add(factor, b[2])]
}

/// a · b
#[inline(always)]
pub fn dot<S: Simd>(a: Pack3<S>, b: Pack3<S>) -> Pack<S> {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// a × b
#[inline(always)]
pub fn cross<S: Simd>(a: Pack3<S>, b: Pack3<S>) -> Pack3<S> {
    [
        a[1].mul_add(b[2], -(a[2] * b[1])),
        a[2].mul_add(b[0], -(a[0] * b[2])),
        a[0].mul_add(b[1], -(a[1] * b[0])),
    ]
}
