//! The deliverables, read by programs that are not ours. `.ci/run` installs them into `target/validators`.

use std::path::{Path, PathBuf};
use std::process::Command;

use cosurf_tests::skips::skip;

/// Fails unless all points come back, whole and thinned out, from a file that is a valid COPC.
const POINTS: &str = "
import sys
from laspy import CopcReader
with CopcReader.open(sys.argv[1]) as reader:
    wanted = int(sys.argv[2])
    assert reader.header.point_count == wanted, reader.header.point_count
    assert 'UTM zone 33N' in str(reader.header.vlrs.get('WktCoordinateSystemVlr')[0].string)
    assert len(reader.query()) == wanted
    assert 0 < len(reader.query(resolution=1.0)) <= wanted
";
/// Fails unless the validator of Khronos finds neither errors nor warnings. Its newest version, 2.0.0-dev.3.10, does not know
/// KHR_gaussian_splatting, and takes the names of its attributes for wrong.
const GLTF: &str = "
const { validateBytes } = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
validateBytes(bytes).then(({ issues }) => {
    const isUnknown = ({ code, pointer }) =>
        code == 'MESH_PRIMITIVE_INVALID_ATTRIBUTE' && pointer.includes('/KHR_gaussian_splatting:');
    const found = issues.messages.filter((issue) => issue.severity < 2 && !isUnknown(issue));
    if (found.length > 0 || issues.truncated) throw new Error(JSON.stringify(found));
});
";

/// Checks the maps, the points, the mesh and the tiles of a survey.
pub(super) fn check(out: &Path, points: u64) {
    check_maps(out);
    check_points(&out.join("points.laz"), points);
    check_meshes(out);
    check_tileset(&out.join("tileset.json"));
    check_tileset(&out.join("splats/tileset.json"));
}

/// Where `.ci/run` installs validators.
fn installed() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/validators")
}

/// Runs a command and fails if it does.
fn run(command: &mut Command) {
    let output = command.output().unwrap();
    let told = [output.stdout, output.stderr].map(|of| String::from_utf8_lossy(&of).into_owned()).concat();
    assert!(output.status.success(), "{command:?}: {told}");
}

/// A Python that has a module; `None` if there is none.
fn python_with(module: &str) -> Option<Command> {
    let own = installed().join("bin/python");
    let python = if own.exists() { own } else { "python3".into() };
    let has = Command::new(&python).args(["-c", &format!("import {module}")]).output().ok()?.status.success();
    has.then(|| Command::new(python))
}

fn check_maps(out: &Path) {
    if python_with("rio_cogeo").is_none() {
        return skip("REQUIRE_VALIDATORS", "Python has no package rio-cogeo");
    }
    for map in ["dsm.tif", "dtm.tif", "ortho.tif", "confidence.tif"] {
        let Some(mut python) = python_with("rio_cogeo") else { return };
        let program =
            "import sys; from rio_cogeo import cog_validate; r = cog_validate(sys.argv[1]); assert r[0], r";
        run(python.args(["-c", program]).arg(out.join(map)));
    }
}

fn check_points(file: &Path, count: u64) {
    let Some(mut python) = python_with("laspy, lazrs") else {
        return skip("REQUIRE_VALIDATORS", "Python has no package laspy[lazrs]");
    };
    run(python.args(["-c", POINTS]).arg(file).arg(count.to_string()));
}

fn check_meshes(out: &Path) {
    let modules = installed().join("node_modules");
    if !modules.join("gltf-validator").exists() {
        return skip("REQUIRE_GLTF_VALIDATOR", "gltf-validator is not installed");
    }
    let folders = ["tiles", "splats"].map(|folder| std::fs::read_dir(out.join(folder)).unwrap());
    let files = folders.into_iter().flatten().map(|file| file.unwrap().path());
    let tiles = files.filter(|file| file.extension().is_some_and(|extension| extension == "glb"));
    for file in tiles.chain([out.join("mesh.glb")]) {
        run(Command::new("node").env("NODE_PATH", &modules).args(["-e", GLTF]).arg(file));
    }
}

fn check_tileset(file: &Path) {
    let validator = installed().join("node_modules/.bin/3d-tiles-validator");
    if !validator.exists() {
        return skip("REQUIRE_3D_TILES_VALIDATOR", "3d-tiles-validator is not installed");
    }
    let report = file.with_file_name("report.json");
    run(Command::new(validator).arg("--tilesetFile").arg(file).arg("--reportFile").arg(&report));
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(report).unwrap()).unwrap();
    assert_eq!(report["numErrors"].as_u64().unwrap_or(0), 0, "{report}");
}
