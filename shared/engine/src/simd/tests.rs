//! Compares every instruction set of this machine with scalar arithmetic, and all of them with each other, bit by bit.

use super::isa::Isa;
use super::lanes::{GROUP, Kernel, Lanes, Total};

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
            rows.extend(
                (0..L::N).map(|i| ("fused", L::fused(sa[i], sb[i], sa[i]), sa[i].mul_add(sb[i], sa[i]))),
            );
            let expected_bits = (0..L::N).map(|i| u32::from(sa[i] < sb[i]) << i).sum::<u32>();
            rows.push(("bits", L::bits(a.lt(b)) as f32, expected_bits as f32));
            let none = L::and_not(a.lt(b), a.lt(b));
            let same = L::and(a.lt(b), L::mask_all(true));
            rows.push(("any", f32::from(u8::from(L::any(none))), 0.0));
            rows.push(("and", L::bits(same) as f32, expected_bits as f32));
        }
        for group in self.a.chunks_exact(GROUP) {
            let totals: [Total<L>; GROUP] = std::array::from_fn(|i| total(group, i as f32));
            for (i, (total, sum)) in totals.iter().zip(L::sums(&totals).0).enumerate() {
                let v: [f32; GROUP] = std::array::from_fn(|k| group[k] * i as f32);
                rows.push(("sum", total.sum(), halved(&v)));
                let quarter = |k: usize| (v[k] + v[k + 2]) + (v[k + 1] + v[k + 3]);
                rows.push(("sums", sum, (quarter(0) + quarter(4)) + (quarter(8) + quarter(12))));
            }
        }
        rows
    }
}

/// A group times a factor.
fn total<L: Lanes>(group: &[f32], factor: f32) -> Total<L> {
    let mut total = Total::zero();
    for part in 0..GROUP / L::N {
        total[part] = L::load(&group[part * L::N..]) * L::splat(factor);
    }
    total
}

/// The sum of the halves of a list, lane by lane, until one number is left.
fn halved(v: &[f32]) -> f32 {
    let (left, right) = v.split_at(v.len() / 2);
    if left.is_empty() {
        return v[0];
    }
    halved(&left.iter().zip(right).map(|(a, b)| a + b).collect::<Vec<_>>())
}

fn values() -> [Vec<f32>; 2] {
    let a = (0..64).map(|i| (i as f32 - 31.0) * 1.37).chain([0.5, 1.5, -2.5, 80.0].repeat(4)).collect();
    [a, (0..80).map(|i| ((i * 37 % 23) as f32 - 11.5) * 0.71).collect()]
}

#[test]
fn every_instruction_set_computes_what_scalars_compute() {
    let [a, b] = values();
    for isa in Isa::available() {
        for (name, got, expected) in isa.run(Everything { a: &a, b: &b }) {
            let tolerance = match name {
                "exp" => 2e-5 * expected,
                "exp2" | "ln_1p" => 4e-7 * expected.abs(),
                _ => 0.0,
            };
            assert!((got - expected).abs() <= tolerance, "{} {name}: {got} is not {expected}", isa.name());
        }
    }
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let [a, b] = values();
    let bits_of = |isa: Isa, name: &str| -> Vec<u32> {
        let rows = isa.run(Everything { a: &a, b: &b });
        rows.into_iter().filter(|row| row.0 == name).map(|(_, got, _)| got.to_bits()).collect()
    };
    let plain = Isa::Plain;
    for isa in Isa::available() {
        for name in ["mul_add", "exp", "exp2", "ln_1p", "sum", "sums", "fused"] {
            assert_eq!(bits_of(isa, name), bits_of(plain, name), "{} {name}", isa.name());
        }
    }
}

/// Numbers of all sizes, also those that cancel almost, that are below the smallest normal one, and infinite ones.
#[test]
fn numbers_are_multiplied_and_added_with_one_rounding_without_an_instruction_for_it() {
    use super::plain::Plain;
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 32) as u32
    };
    for round in 0..300_000 {
        let [a, b, mut c] = [random(), random(), random()].map(f32::from_bits);
        if round % 3 == 0 {
            c = -a * b * (1.0 + (random() % 9) as f32 * f32::EPSILON);
        }
        let (got, expected) = (Plain::fused(a, b, c), a.mul_add(b, c));
        let is_same = got.to_bits() == expected.to_bits() || (got.is_nan() && expected.is_nan());
        assert!(is_same, "{a:e} * {b:e} + {c:e} is {expected:e}, not {got:e}");
    }
}
