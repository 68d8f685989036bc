//! What a [`Scalar::Table`](super::Scalar::Table) is made from: an odd function that rises from 0 to 1.

/// Segments of a graded table.
pub const SEGMENTS: usize = 32;

/// Index of its last one, which is the constant 1.
const LAST: usize = SEGMENTS - 1;

/// An odd function of v that rises from 0 to 1.
pub struct Curve<'a> {
    /// Up to where it is so nearly straight that one quadratic serves. Zero or positive.
    pub start: f32,
    /// From where it is 1. Above `start`.
    pub end: f32,
    /// What v = 1 is, in the unit of the argument. Positive.
    pub unit: f32,
    /// Its value for v ≥ 0.
    pub value: &'a dyn Fn(f32) -> f32,
}

/// A curve by quadratics on a grid of one wide segment up to its start, equal ones to its end, and the constant 1 beyond.
pub struct Graded<'a> {
    curve: &'a Curve<'a>,
    /// Width of an equal segment, in v.
    width: f32,
    /// Position of v = 0; the first segment reaches from here to 1.
    pub origin: f32,
    /// Position per unit of the argument.
    pub per_unit: f32,
}

impl<'a> Graded<'a> {
    /// The grid of a curve. A position is v/width + origin, in segments.
    pub fn new(curve: &'a Curve) -> Self {
        let &Curve { start, end, unit, .. } = curve;
        let (width, origin) = if start > 0.0 {
            let width = (end - start) / (LAST - 1) as f32;
            (width, 1.0 - start / width)
        } else {
            (end / LAST as f32, 0.0)
        };
        Self { curve, width, origin, per_unit: 1.0 / (width * unit) }
    }

    /// Coefficients of a segment's quadratic in the position.
    pub fn segment(&self, index: usize) -> [f32; 3] {
        let Self { origin, .. } = *self;
        let node = |position: f32| self.node(position);
        let left = index as f32;
        match index {
            0 => through_zero(origin, 0.5 * (origin + 1.0), 1.0, node),
            LAST.. => [1.0, 0.0, 0.0],
            _ => {
                let [value, slope, curvature] =
                    rising_parabola([node(left), node(left + 0.5), node(left + 1.0)]);
                [
                    value - left * (slope - left * curvature),
                    slope - 2.0 * left * curvature,
                    curvature,
                ]
            }
        }
    }

    /// The curve's value at a position.
    fn node(&self, position: f32) -> f32 {
        let Self { curve, width, origin, .. } = self;
        if position >= LAST as f32 { 1.0 } else { (curve.value)((position - origin) * width) }
    }
}

/// Coefficients in x of the rising parabola with these values at x = 0, ½ and 1.
///
/// The middle value is moved, where need be, to where the parabola rises all the way: near saturation it would
/// overshoot 1 otherwise.
pub fn rising_parabola([at_left, at_half, at_right]: [f32; 3]) -> [f32; 3] {
    let low = 0.75 * at_left + 0.25 * at_right;
    let high = 0.25 * at_left + 0.75 * at_right;
    // Not `clamp`: the message of its panic is 18 kB of code.
    let middle = at_half.max(low).min(high);
    let slope = 4.0 * middle - 3.0 * at_left - at_right;
    let curvature = 2.0 * (at_left + at_right) - 4.0 * middle;
    [at_left, slope, curvature]
}

/// Coefficients in x of the parabola that is exactly 0 at x = `zero` and meets `node` at `middle` and `end`.
fn through_zero(zero: f32, middle: f32, end: f32, node: impl Fn(f32) -> f32) -> [f32; 3] {
    let slope = |x: f32| node(x) / (x - zero);
    let curvature = (slope(end) - slope(middle)) / (end - middle);
    let linear = slope(end) - curvature * (end + zero);
    // Whatever the rounding, x = zero must give 0: the same operations as where it is looked up.
    let constant = -(zero * (linear + zero * curvature));
    [constant, linear, curvature]
}
