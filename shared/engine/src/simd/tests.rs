//! Compares every instruction set of this machine with scalar arithmetic.

use super::isa::Isa;
use super::lanes::{GROUP, Kernel, Lanes};

/// Applies every operation to values of both signs, to ties of rounding and to large arguments of the exponential.
/// Returns the name of the operation, its result and the expected result.
struct Everything<'a> {
    a: &'a [f32],
    b: &'a [f32],
}

impl Kernel for Everything<'_> {
    type Output = Vec<(&'static str, f32, f32)>;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Self::Output {
        let mut rows = Vec::new();
        let mut out = vec![0.0; L::N];
        for start in (0..self.a.len()).step_by(L::N) {
            let (sa, sb) = (&self.a[start..start + L::N], &self.b[start..start + L::N]);
            let (a, b) = (L::load(sa), L::load(sb));
            type Scalar = fn(f32, f32) -> f32;
            let cases: [(&'static str, L, Scalar); 16] = [
                ("add", a + b, |a, b| a + b),
                ("sub", a - b, |a, b| a - b),
                ("mul", a * b, |a, b| a * b),
                ("div", a / b, |a, b| a / b),
                ("mul_add", a.mul_add(b, a), |a, b| a.mul_add(b, a)),
                ("neg_mul_add", a.neg_mul_add(b, a), |a, b| (-a).mul_add(b, a)),
                ("min", a.min(b), f32::min),
                ("max", a.max(b), f32::max),
                ("sqrt", a.abs().sqrt(), |a, _| a.abs().sqrt()),
                ("round", a.round(), |a, _| a.round_ties_even()),
                ("exp", a.exp(), |a, _| f64::from(a).exp() as f32),
                ("exp2", a.exp2(), |a, _| f64::from(a).exp2() as f32),
                ("ln_1p", (a * a / (a * a + b * b)).ln_1p(), |a, b| (a * a / (a * a + b * b)).ln_1p()),
                ("select", L::select(a.lt(b), a, b), |a, b| if a < b { a } else { b }),
                ("keep", a.keep(a.ge(b)), |a, b| if a >= b { a } else { 0.0 }),
                ("neg", a.neg(), |a, _| 0.0 - a),
            ];
            for (name, got, expected) in cases {
                got.store(&mut out);
                rows.extend((0..L::N).map(|i| (name, out[i], expected(sa[i], sb[i]))));
            }
            rows.push(("sum", a.sum(), sa.iter().sum()));
            let vectors: [L; GROUP] = std::array::from_fn(|i| a * L::splat(i as f32));
            for (i, sum) in L::sums(&vectors).0.into_iter().enumerate() {
                rows.push(("sum", sum, sa.iter().map(|v| v * i as f32).sum()));
            }
            let expected_bits = (0..L::N).map(|i| u32::from(sa[i] < sb[i]) << i).sum::<u32>();
            rows.push(("bits", L::bits(a.lt(b)) as f32, expected_bits as f32));
            let none = L::and_not(a.lt(b), a.lt(b));
            let same = L::and(a.lt(b), L::mask_all(true));
            rows.push(("any", f32::from(u8::from(L::any(none))), 0.0));
            rows.push(("and", L::bits(same) as f32, expected_bits as f32));
        }
        rows
    }
}

#[test]
fn every_instruction_set_computes_what_scalars_compute() {
    let a: Vec<f32> =
        (0..64).map(|i| (i as f32 - 31.0) * 1.37).chain([0.5, 1.5, -2.5, 80.0].repeat(4)).collect();
    let b: Vec<f32> = (0..80).map(|i| ((i * 37 % 23) as f32 - 11.5) * 0.71).collect();
    for isa in Isa::available() {
        for (name, got, expected) in isa.run(Everything { a: &a, b: &b }) {
            let tolerance = match name {
                "sum" => 2e-3,
                "mul_add" | "neg_mul_add" => 2e-5,
                "exp" => 2e-5 * expected,
                _ => 4e-7 * expected.abs(),
            };
            assert!((got - expected).abs() <= tolerance, "{} {name}: {got} is not {expected}", isa.name());
        }
    }
}
