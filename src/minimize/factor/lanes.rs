//! Eight numbers at a time: AVX-512 where the machine has it, else arrays that the compiler turns into what there is.

use super::fronts::LANES;

/// Eight numbers.
pub trait Lanes: Copy {
    /// Tile height in registers: with six columns, what fits beside operands.
    const HEIGHT: usize;
    fn splat(value: f64) -> Self;
    fn load(from: &[f64; LANES]) -> Self;
    fn store(self, to: &mut [f64; LANES]);
    /// self − a b
    fn minus(self, a: Self, b: Self) -> Self;
    fn times(self, factor: Self) -> Self;
    fn sum(self) -> f64;
    /// Adds one slice to another of the same length.
    fn add(to: &mut [f64], from: &[f64]);
}

/// Plain numbers; `FUSED` where the machine multiplies and adds in one instruction.
#[derive(Clone, Copy)]
pub struct Plain<const FUSED: bool>([f64; LANES]);

impl<const FUSED: bool> Lanes for Plain<FUSED> {
    const HEIGHT: usize = 1;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Plain([value; LANES])
    }

    #[inline(always)]
    fn load(from: &[f64; LANES]) -> Self {
        Plain(*from)
    }

    #[inline(always)]
    fn store(self, to: &mut [f64; LANES]) {
        *to = self.0;
    }

    #[inline(always)]
    fn minus(self, a: Self, b: Self) -> Self {
        let mut out = self;
        for k in 0..LANES {
            out.0[k] = if FUSED { (-a.0[k]).mul_add(b.0[k], self.0[k]) } else { self.0[k] - a.0[k] * b.0[k] };
        }
        out
    }

    #[inline(always)]
    fn times(self, factor: Self) -> Self {
        let mut out = self;
        (0..LANES).for_each(|k| out.0[k] *= factor.0[k]);
        out
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        let [a, b, c, d, e, f, g, h] = self.0;
        ((a + e) + (c + g)) + ((b + f) + (d + h))
    }

    #[inline(always)]
    fn add(to: &mut [f64], from: &[f64]) {
        to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
    }
}

#[cfg(target_arch = "x86_64")]
pub use wide::Wide;

#[cfg(target_arch = "x86_64")]
mod wide {
    use super::{LANES, Lanes};
    use std::arch::x86_64::*;

    /// A register of AVX-512. Only `dense::Machine::Avx512`, which has asked the processor, gets here.
    #[derive(Clone, Copy)]
    pub struct Wide(__m512d);

    // Safety, of every block below: loads and stores go through references of the right length, and the instructions exist
    // because the caller is compiled for AVX-512 and entered after asking the processor.
    impl Lanes for Wide {
        const HEIGHT: usize = 4;

        #[inline(always)]
        fn splat(value: f64) -> Self {
            Wide(unsafe { _mm512_set1_pd(value) })
        }

        #[inline(always)]
        fn load(from: &[f64; LANES]) -> Self {
            Wide(unsafe { _mm512_loadu_pd(from.as_ptr()) })
        }

        #[inline(always)]
        fn store(self, to: &mut [f64; LANES]) {
            unsafe { _mm512_storeu_pd(to.as_mut_ptr(), self.0) }
        }

        #[inline(always)]
        fn minus(self, a: Self, b: Self) -> Self {
            Wide(unsafe { _mm512_fnmadd_pd(a.0, b.0, self.0) })
        }

        #[inline(always)]
        fn times(self, factor: Self) -> Self {
            Wide(unsafe { _mm512_mul_pd(self.0, factor.0) })
        }

        #[inline(always)]
        fn sum(self) -> f64 {
            unsafe { _mm512_reduce_add_pd(self.0) }
        }

        #[inline(always)]
        fn add(to: &mut [f64], from: &[f64]) {
            let (to, to_rest) = to.as_chunks_mut::<LANES>();
            let (from, from_rest) = from.as_chunks::<LANES>();
            for (to, from) in to.iter_mut().zip(from) {
                Wide(unsafe { _mm512_add_pd(Self::load(to).0, Self::load(from).0) }).store(to);
            }
            let rest = to_rest.len().min(from_rest.len());
            if rest > 0 {
                let mask = (1u8 << rest) - 1;
                unsafe {
                    let sum = _mm512_add_pd(
                        _mm512_maskz_loadu_pd(mask, to_rest.as_ptr()),
                        _mm512_maskz_loadu_pd(mask, from_rest.as_ptr()),
                    );
                    _mm512_mask_storeu_pd(to_rest.as_mut_ptr(), mask, sum);
                }
            }
        }
    }
}
