//! Checks that no closure calls an intrinsic of x86. A closure is compiled for the baseline processor, even inside a function
//! that enables AVX2. If the closure is not inlined, each of its intrinsics becomes a call. Trainings took a third longer with
//! AVX2 because of that.

use std::fs;

use syn::visit::{Visit, visit_expr_closure, visit_path};

use super::root;

/// The intrinsics that closures call.
#[derive(Default)]
struct InClosures {
    depth: usize,
    found: Vec<String>,
}

impl<'a> Visit<'a> for InClosures {
    fn visit_expr_closure(&mut self, closure: &'a syn::ExprClosure) {
        self.depth += 1;
        visit_expr_closure(self, closure);
        self.depth -= 1;
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        let names = path.segments.iter().map(|segment| segment.ident.to_string());
        self.found.extend(names.filter(|name| self.depth > 0 && name.starts_with("_mm")));
        visit_path(self, path);
    }
}

fn in_closures(text: &str) -> Vec<String> {
    let mut visitor = InClosures::default();
    visitor.visit_file(&syn::parse_file(text).unwrap());
    visitor.found
}

#[test]
fn no_intrinsic_is_called_in_a_closure() {
    for file in ["avx2.rs", "avx512.rs"] {
        let path = root().join("shared/engine/src/simd").join(file);
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains("_mm"), "{file} has no intrinsics any more; look elsewhere");
        assert_eq!(in_closures(&text), Vec::<String>::new(), "{file}");
    }
}

#[test]
fn intrinsics_in_closures_are_found() {
    let inside = "fn f() { let add = |a, b| unsafe { std::arch::x86_64::_mm256_add_ps(a, b) }; }";
    assert_eq!(in_closures(inside), ["_mm256_add_ps"]);
    assert!(in_closures("fn f() { let one = || 1; _mm256_add_ps(a, b); }").is_empty());
}
