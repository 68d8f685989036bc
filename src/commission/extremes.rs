//! The lesser and the greater of two numbers.

/// A third of the code that `f32::min` and `f32::max` take: of two numbers of which one is no number it is `other`.
pub(super) trait Extremes {
    fn lesser(self, other: Self) -> Self;
    fn greater(self, other: Self) -> Self;
}

impl Extremes for f32 {
    fn lesser(self, other: f32) -> f32 {
        if self < other { self } else { other }
    }

    fn greater(self, other: f32) -> f32 {
        if self > other { self } else { other }
    }
}
