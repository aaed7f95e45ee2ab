//! Quantiles of what was measured.

/// Values in order.
pub struct Sorted(Vec<f64>);

impl Sorted {
    /// These, in order.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Sorted {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        Sorted(values)
    }

    /// The value up to which the fraction `q` of them lies (nearest rank); not a number of none.
    pub fn at(&self, q: f64) -> f64 {
        let rank = (q * self.0.len() as f64).ceil() as usize;
        self.0.get(rank.max(1) - 1).copied().unwrap_or(f64::NAN)
    }
}

/// The median; of an even number of values the lower of both in the middle.
pub fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    Sorted::of(values).at(0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_by_nearest_rank() {
        let sorted = Sorted::of([3.0, 1.0, 2.0, 4.0]);
        assert_eq!([0.0, 0.25, 0.26, 0.5, 0.99, 1.0].map(|q| sorted.at(q)), [1.0, 1.0, 2.0, 2.0, 4.0, 4.0]);
        assert!(Sorted::of([]).at(0.5).is_nan());
        assert_eq!(median([5.0]), 5.0);
    }
}
