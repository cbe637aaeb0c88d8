//! Mistyped arguments: each program reports the mistake and the correction.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::path::Path;
use std::process::Command;

use palpate_geometry::write::{Format, write};
use palpate_geometry::{TriangleMesh, organ};

/// Exit status, and both outputs.
fn palpate(folder: &Path, arguments: &[&str]) -> (i32, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_palpate")).args(arguments).current_dir(folder).output().unwrap();
    let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    (output.status.code().unwrap(), text)
}

fn says((status, text): (i32, String), expected: i32, parts: &[&str]) {
    assert_eq!(status, expected, "{text}");
    parts.iter().for_each(|part| assert!(text.contains(part), "`{part}` is not in {text}"));
}

/// A liver of 1,500 vertices or so.
fn liver() -> TriangleMesh {
    organ::generate("liver".parse().unwrap(), 0.007, 1).unwrap()
}

#[test]
fn a_wrong_value_is_refused_for_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("liver.obj"), write(&liver(), Format::of("x.obj").unwrap())).unwrap();
    std::fs::create_dir(at("empty")).unwrap();
    std::fs::create_dir(at("mine")).unwrap();
    std::fs::write(at("mine/poke.toml"), "scenes = [\"paper\"]\nduration_s = 1.0\n").unwrap();
    for (name, text) in [
        ("a.toml", "lissen = \"127.0.0.1:0\"\n"),
        ("b.toml", "[limits]\nmax_sessions = 3\n"),
        ("c.toml", "[limit]\nsessions = 3\n"),
        ("d.toml", "colour = 3\n"),
    ] {
        std::fs::write(at(name), text).unwrap();
    }
    for (arguments, parts) in [
        (&["mesh", "liver.obj", "--unit", "-1"][..], &["--unit: `-1` is not a unit"][..]),
        (
            &["organ", "liver", "--edge-mm", "-2", "--output", "x.obj"],
            &["--edge-mm: the edge length must be", "-0.002"],
        ),
        (&["organ", "liver", "--edge-mm", "-1e-3", "--output", "x.obj"], &["--edge-mm: the edge length must be"]),
        (&["serve", "--threads", "-1"], &["--threads: must be a whole number from 0, but is `-1`"]),
        (&["certificate", "--days", "-3"], &["-3 is not in 1..=825"]),
        (&["organ", "spleen"], &["there is no organ `spleen`; there are gallbladder"]),
        (&["organ", "liver"], &["--output: is missing", "liver.obj"]),
        (&["mesh", "liver.obj", "--unit", "m", "--vertices", "2"], &["--vertices: must be at least 4, but is 2"]),
        (
            &["serve", "--viewer", "empty", "--listen", "127.0.0.1:0"],
            &["--viewer empty: has no .html file", "npm run build"],
        ),
        (&["serve", "--config", "a.toml"], &["a.toml:1", "unknown key; did you mean `listen`?"]),
        (&["serve", "--config", "b.toml"], &["b.toml:2", "unknown key; did you mean `sessions`?"]),
        (&["serve", "--config", "c.toml"], &["c.toml:1", "unknown key; did you mean `limits`?"]),
        (&["serve", "--config", "d.toml"], &["d.toml:1", "unknown key; known here: listen, tls_cert"]),
        (&["serve", "--journal-key", "a.key"], &["journal: is missing, but journal_key requires it"]),
        (&["check", "poke", "--scenes", "mine"], &["poke.toml: is a script in the folder of scenes: move it"]),
        (&["render", "paper", "vertical-60", "--at", "9999", "--output", "p.png"], &["--at: must be from 0 to 1000"]),
        (&["token", "--name", "", "--role", "watch"], &["name: is empty"]),
        (&["token", "--name", " ", "--role", "watch"], &["name: is empty"]),
    ] {
        says(palpate(folder.path(), arguments), 2, parts);
    }
    let picture = ["render", "paper", "vertical-60", "--at", "300", "--size", "32x32", "--output", "p.png"];
    says(palpate(folder.path(), &picture), 0, &[]);
}

#[test]
fn a_length_in_millimetres_is_taken_for_one() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |radius_m: &str, place_m: &str, parts: &[&str]| {
        let text = format!(
            "duration_s = 0.1\nsample_every_s = 0.05\n[[tool]]\ntip = {{ radius_m = {radius_m}, friction = 0.2 }}\n\
             poses = [{{ at_s = 0.0, place_m = {place_m} }}]\n"
        );
        std::fs::write(folder.path().join("s.toml"), text).unwrap();
        says(palpate(folder.path(), &["run", "liver", "s.toml"]), 2, parts);
    };
    refused("0.005", "[37.5, 37.5, 53.0]", &["must be at most", "millimetres? All lengths are in metres"]);
    refused("5.0", "[0.0375, 0.0375, 0.002]", &["radius_m: must be above 0", "millimetres? All lengths are in metres"]);
}

#[test]
fn a_server_that_does_not_begin_says_no_address() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("file"), "").unwrap();
    let usual = ["serve", "--listen", "127.0.0.1:0", "--journal"];
    for (more, told) in [
        (&["file"][..], "journal: file: can't be used"),
        (&["journals", "--journal-key", "file"], "file: has no private key in PEM"),
        (&["journals", "--journal-key", "none"], "none: can't be opened"),
        // Which is read to its end.
        (&["journals", "--journal-key", "/dev/zero"], "/dev/zero: is larger than the limit of 1048576 bytes"),
    ] {
        let (status, text) = palpate(folder.path(), &[&usual[..], more].concat());
        assert!(status == 2 && text.contains(told) && !text.contains("listens"), "{status}: {text}");
    }
}

#[test]
fn an_owner_has_one_token_of_a_name() {
    let folder = tempfile::tempdir().unwrap();
    let make = |name: &str| palpate(folder.path(), &["token", "--name", name, "--role", "watch", "--tokens", "t.toml"]);
    says(make("ann"), 0, &["palpate_"]);
    says(make("ann"), 2, &["`ann` is the name of another entry in this file"]);
    says(make("bob"), 0, &["palpate_"]);
    let text = std::fs::read_to_string(folder.path().join("t.toml")).unwrap();
    assert_eq!(text.matches("[[token]]").count(), 2, "{text}");
}

#[test]
fn check_tells_what_helps_against_a_fast_vertex_as_tried() {
    let folder = tempfile::tempdir().unwrap();
    let mut mesh = liver();
    let [a, b, _] = mesh.triangles[700].map(|vertex| vertex as usize);
    mesh.vertices_m[a] = mesh.vertices_m[a].lerp(mesh.vertices_m[b], 0.97);
    std::fs::write(folder.path().join("bad.obj"), write(&mesh, Format::of("x.obj").unwrap())).unwrap();
    let scene = "[mesh]\nfile = \"bad.obj\"\nunit = \"m\"\nfixed = { group = \"bare-area\" }\n[material]\n\
        youngs_modulus_pa = 8000.0\nthickness_m = 0.0005\nfoundation_n_per_m3 = 1.34e6\ndamping_ratio = 0.5\n";
    std::fs::write(folder.path().join("bad.toml"), scene).unwrap();
    let (status, text) = palpate(folder.path(), &["check", "bad.toml"]);
    assert!(status == 0 && text.contains("times as fast as half of the mesh") && !text.contains("--repair"), "{text}");
    let fewer = mesh.vertices_m.len() - 1;
    assert!(text.contains(&format!("advice: vertices = {fewer} in [mesh] takes ")), "{text}");
    let advice = text.lines().find(|line| line.starts_with("advice")).unwrap();
    let numbers: Vec<u32> = advice.split(' ').filter_map(|word| word.trim_end_matches(',').parse().ok()).collect();
    assert!(numbers[1] < numbers[2], "{advice}");
    let (_, text) = palpate(folder.path(), &["check", "bad.toml", "--set", &format!("mesh.vertices={fewer}")]);
    assert!(!text.contains("advice"), "{text}");
    let substeps = format!(", {} times a step", numbers[1]);
    assert!(text.contains(&substeps) || numbers[1] == 1 && text.contains("once a step"), "{advice}\n{text}");
}

/// Returns a figure of all tools in a score.
fn figure(score: &serde_json::Value, name: &str) -> f64 {
    let measures = score["measures"].as_array().unwrap();
    let found = measures.iter().find(|measure| measure["name"] == name && measure.get("tool").is_none());
    found.unwrap_or_else(|| panic!("{name} is not in {score}"))["value"].as_f64().unwrap()
}

#[test]
fn a_score_has_what_the_tools_did_and_sessions_compare() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
    let run = |more: &[&str]| {
        palpate(folder.path(), &[&["run", "liver", "press", "--quiet", "--output", "r.jsonl"], more].concat())
    };
    says(run(&["--score", "run.json", "--force-limit-n", "0.2"]), 0, &[]);
    let score: serde_json::Value = serde_json::from_str(&read("run.json")).unwrap();
    // 6 mm down and up, 71 N/m or more under a disc of 5 mm.
    assert!((figure(&score, "path_length_m") - 0.012).abs() < 1e-6, "{score}");
    assert_eq!((figure(&score, "time_s"), figure(&score, "press_count")), (2.0, 1.0));
    let (peak_n, peak_pa) = (figure(&score, "peak_force_n"), figure(&score, "peak_pressure_pa"));
    assert!(
        peak_n > 0.28 && (peak_pa * std::f64::consts::PI * 2.5e-5 / peak_n - 1.0).abs() < 1e-3,
        "{peak_n} {peak_pa}"
    );
    let disc_m2 = figure(&score, "covered_area_m2") / (std::f64::consts::PI * 2.5e-5);
    assert!((disc_m2 - 1.0).abs() < 0.1, "{disc_m2}");
    let crossing = &score["limit_crossings"][0];
    assert!(
        score["limit_crossing_count"] == 1 && crossing["peak"] == peak_n && crossing["limit"] == "force_n",
        "{crossing}"
    );
    // As a page and as a table too, without a file for the score.
    let (status, table) =
        palpate(folder.path(), &["run", "liver", "press", "--output", "r.jsonl", "--report", "run.html"]);
    let row = |line: &&str| line.starts_with("peak_force_n ");
    assert!(status == 0 && table.contains("final hash") && table.lines().any(|line| row(&line)), "{table}");
    assert!(read("run.html").contains("press on liver") && read("run.html").contains("<svg"));
    // The journal is simulated, and gives the same figures on paper and in the file.
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/journal/golden.6.mcap");
    let scored = |more: &[&str]| palpate(folder.path(), &[&["journal", "score", golden], more].concat());
    let (status, table) = scored(&["--output", "golden.json", "--report", "golden.html", "--force-limit-n", "1e-4"]);
    assert_eq!((status, table.as_str()), (0, ""));
    let (status, json) = scored(&["--json", "--force-limit-n", "1e-4"]);
    assert_eq!((status, json), (0, read("golden.json")));
    let report = read("golden.html");
    for part in ["<svg", "data:image/png;base64,", "force_integral_n_s", "palpate journal render golden.6.mcap --at"] {
        assert!(report.contains(part), "{part} is not in {report}");
    }
    let compared =
        palpate(folder.path(), &["journal", "compare", "golden.json", "run.json", golden, "--csv", "all.csv"]);
    says(compared, 0, &["has other thresholds", "sparc[0]", "50 %", "golden.6.mcap"]);
    let csv = read("all.csv");
    let columns: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
    assert!(columns.len() == 4 && columns.iter().all(|count| *count == columns[0]), "{csv}");
    for (arguments, part) in [
        (
            &["run", "liver", "press", "--force-limit-n", "2"][..],
            "--force-limit-n: goes with --score FILE or --report FILE alone",
        ),
        (
            &["run", "liver", "press", "--exercise", "cut-line"],
            "--exercise: goes with --score FILE or --report FILE alone",
        ),
        (&["run", "liver", "indent", "--score", "s.json"], "--score: goes with a script, not with `indent`"),
        (&["run", "liver", "indent", "--report", "s.html"], "--report: goes with a script, not with `indent`"),
        (&["run", "liver", "press", "--score", "s.json", "--press-n", "-1"], "--press-n: must be above 0"),
        (&["journal", "score", golden, "--hand", "0,1"], "--hand: must be two hands"),
        (&["journal", "score", golden, "--hand", "0", "--hand", "0"], "--hand: a tool must be in one hand only"),
        (&["journal", "score", "run.json"], "run.json"),
        (&["journal", "compare", &at("r.jsonl")], "is neither a journal nor a score"),
    ] {
        says(palpate(folder.path(), arguments), 2, &[part]);
    }
}

#[test]
fn an_exercise_is_judged_by_its_truth_and_another_seed_hides_something_else() {
    let folder = tempfile::tempdir().unwrap();
    let read = |name: &str| -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(folder.path().join(name)).unwrap()).unwrap()
    };
    let script = |name: &str, marks: &[(f64, f64)]| {
        let mut text = "duration_s = 0.2\nsample_every_s = 0.1\n[[tool]]\ntip = { shape = \"sphere\" }\n\
                        poses = [{ at_s = 0.0, place_m = [0.0, 0.0, 0.046] }, { at_s = 0.1, place_m = [0.0, 0.0, 0.043] }]\n"
            .to_owned();
        for (x, y) in marks {
            text += &format!("[[mark]]\nat_s = 0.15\nplace_m = [{x}, {y}, 0.04]\ndiameter_m = 0.017\n");
        }
        std::fs::write(folder.path().join(name), text).unwrap();
    };
    let run = |script: &str, score: &str, more: &[&str]| {
        let run =
            ["run", "phantom", script, "--quiet", "--output", "r.jsonl", "--score", score, "--exercise", "lumps-2"];
        palpate(folder.path(), &[&run[..], more].concat())
    };
    script("silent.toml", &[]);
    says(run("silent.toml", "silent.json", &["--seed", "7"]), 0, &[]);
    let silent = read("silent.json");
    let lumps = silent["exercise"]["lumps"].as_array().unwrap();
    let at = |lump: &serde_json::Value| (lump["centre_m"][0].as_f64().unwrap(), lump["centre_m"][1].as_f64().unwrap());
    let found: Vec<(f64, f64)> = lumps.iter().map(at).collect();
    assert!(!found.is_empty() && figure(&silent, "hits") == 0.0 && figure(&silent, "misses") == found.len() as f64);
    // A mark over each lump, and one in a corner.
    let marks: Vec<_> = found.iter().copied().chain([(0.049, 0.049)]).collect();
    script("sure.toml", &marks);
    says(run("sure.toml", "sure.json", &["--seed", "7"]), 0, &[]);
    let sure = read("sure.json");
    for (name, expected) in [("hits_share", 1.0), ("misses", 0.0), ("false_alarms", 1.0), ("place_error_m", 0.0)] {
        assert!((figure(&sure, name) - expected).abs() < 1e-9, "{name}: {sure}");
    }
    let percent = |score: &serde_json::Value| score["exercise"]["score_percent"].as_f64().unwrap();
    assert!(figure(&sure, "d_prime") > figure(&silent, "d_prime") && percent(&sure) > percent(&silent), "{sure}");
    assert_eq!(sure["exercise"]["answers"].as_array().unwrap().len(), marks.len());
    // What is hidden is felt: the tissue is another one.
    says(run("silent.toml", "other.json", &["--seed", "8"]), 0, &[]);
    assert_ne!(read("other.json")["exercise"]["lumps"], silent["exercise"]["lumps"]);
    assert_ne!(figure(&read("other.json"), "peak_force_n"), figure(&silent, "peak_force_n"));
    std::fs::write(
        folder.path().join("mine.toml"),
        "name = \"mine\"\ninstructions = \"Press.\"\nscenes = [\"liver\"]\n[[criterion]]\nmeasure = \"peak_forc_n\"\npoor = 2\ngood = 1\n",
    )
    .unwrap();
    for (exercise, part) in [
        ("lumps-9", "there is no exercise `lumps-9`"),
        ("mine.toml", "there is no measure `peak_forc_n`; did you mean `peak_force_n`?"),
        ("silent.toml", "silent.toml: is a script"),
    ] {
        says(palpate(folder.path(), &["check", "liver", "--exercise", exercise]), 2, &[part]);
    }
    says(
        palpate(folder.path(), &["check", "liver", "--exercise", "lumps-1"]),
        2,
        &["exercise lumps-1", "does not fit", "inclusion"],
    );
    let valid = palpate(folder.path(), &["check", "phantom", "--exercise", "lumps-1", "--seed", "7"]);
    says(valid, 0, &["exercise      lumps-1, valid: ", "with seed 7", "120 s", "criteria"]);
    says(palpate(folder.path(), &["check", "fibrotic", "--exercise", "cut-line"]), 0, &["made for liver"]);
}

/// A blade along the line of `close-wound`, and three stitches across it.
fn cut_and_sewn() -> String {
    let upright = "orientation = [0.70710678, 0, 0.70710678, 0]";
    let mut text =
        "duration_s = 3.0\nsample_every_s = 0.5\n[[tool]]\nblade = { length_m = 0.02 }\nuntil_s = 1.3\nposes = [\n"
            .to_owned();
    for (at_s, y, z) in [(0.0, 0.0205, 0.004), (0.2, 0.0205, -0.006), (1.1, 0.056, -0.006), (1.25, 0.056, 0.004)] {
        text += &format!("{{ at_s = {at_s}, place_m = [0.03625, {y}, {z}], {upright} }},\n");
    }
    text += "]\n";
    for y in [0.0295, 0.0375, 0.0455] {
        text += &format!(
            "[[thread]]\nbites = [{{ place_m = [0.03225, {y}, 0], radius_m = 0.002 }}, {{ place_m = [0.04025, {y}, 0], radius_m = 0.002 }}]\n\
             length_m = [{{ at_s = 1.4, length_m = 0.014 }}, {{ at_s = 1.9, length_m = 0.0075 }}]\n"
        );
    }
    text
}

#[test]
fn who_does_what_an_exercise_asks_earns_it_and_who_does_not_earns_little() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sew.toml"), cut_and_sewn()).unwrap();
    let idle = "duration_s = 0.1\nsample_every_s = 0.1\n[[tool]]\ntip = {}\nposes = [{ at_s = 0.0, place_m = [0.03, 0.03, 0.01] }]\n";
    std::fs::write(folder.path().join("idle.toml"), idle).unwrap();
    let percent = |scene: &str, script: &str, exercise: &str| {
        let run = ["run", scene, script, "--quiet", "--output", "r.jsonl", "--exercise", exercise, "--score", "s.json"];
        says(palpate(folder.path(), &run), 0, &[]);
        let text = std::fs::read_to_string(folder.path().join("s.json")).unwrap();
        let score: serde_json::Value = serde_json::from_str(&text).unwrap();
        (score["exercise"]["score_percent"].as_f64().unwrap(), score)
    };
    for (scene, script, exercise, range) in [
        ("liver", "cut", "cut-line", 95.0..=100.0),
        ("liver", "press", "cut-line", 0.0..=30.0),
        ("liver", "sew.toml", "close-wound", 95.0..=100.0),
        ("liver", "cut", "close-wound", 0.0..=30.0),
        ("liver-solid", "lift", "lift-hold", 95.0..=100.0),
        ("liver", "idle.toml", "cut-line", 0.0..=0.0),
    ] {
        let (percent, score) = percent(scene, script, exercise);
        assert!(range.contains(&percent), "{script} earns {percent} % of {exercise}: {score}");
    }
}

#[test]
fn a_script_ends_a_phase_before_its_time_and_what_cannot_be_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let exercise = "name = \"two\"\ninstructions = \"Press, then rest.\"\nscenes = [\"liver\"]\n\
                    [[phase]]\ntitle = \"Press\"\ninstructions = \"Press.\"\ntime_limit_s = 0.09\n\
                    [[phase]]\ntitle = \"Rest\"\ninstructions = \"Rest.\"\n\
                    [[criterion]]\nmeasure = \"press_count\"\nphase = 1\npoor = 0\ngood = 1\n";
    std::fs::write(folder.path().join("two.toml"), exercise).unwrap();
    let run = |ends: &str| {
        let script = format!(
            "duration_s = 0.1\nsample_every_s = 0.1\n[[tool]]\ntip = {{}}\n\
             poses = [{{ at_s = 0.0, place_m = [0.03, 0.03, -0.004] }}]\n{ends}"
        );
        std::fs::write(folder.path().join("script.toml"), script).unwrap();
        let run = [
            "run",
            "liver",
            "script.toml",
            "--quiet",
            "--output",
            "r.jsonl",
            "--exercise",
            "two.toml",
            "--score",
            "s.json",
        ];
        palpate(folder.path(), &run)
    };
    let scored = || -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(folder.path().join("s.json")).unwrap()).unwrap()
    };
    let phases = |score: &serde_json::Value| -> Vec<(u64, u64)> {
        let phases = score["exercise"]["phases"].as_array().unwrap().iter();
        phases.map(|phase| (phase["begin_step"].as_u64().unwrap(), phase["steps"].as_u64().unwrap())).collect()
    };
    let end = |at_s: f64, phase: u32| format!("[[phase_end]]\nat_s = {at_s}\nphase = {phase}\n");
    says(run(""), 0, &[]);
    assert_eq!(phases(&scored()), [(0, 90), (90, 10)]);
    says(run(&end(0.04, 1)), 0, &[]);
    let first = scored();
    assert_eq!(phases(&first), [(0, 40), (40, 60)]);
    // The same bits again; and the last phase ends the exercise.
    says(run(&end(0.04, 1)), 0, &[]);
    assert_eq!(scored(), first);
    says(run(&(end(0.04, 1) + &end(0.06, 2))), 0, &[]);
    assert_eq!(phases(&scored()), [(0, 40), (40, 20)]);
    // Too late: the phase has ended by its time.
    says(run(&end(0.095, 1)), 0, &[]);
    assert_eq!(phases(&scored()), [(0, 90), (90, 10)]);
    for (ends, part) in [
        (end(0.04, 3), "phase_end[0].phase: 3: the exercise `two` has 2 phases"),
        (end(0.04, 0), "phase_end[0].phase: 0: must be from 1 to 8"),
        (end(0.04, 9), "phase_end[0].phase: 9: must be from 1 to 8"),
        (end(0.1, 1), "phase_end[0].at_s: must be before the script ends"),
        (end(0.04, 2) + &end(0.05, 1), "phase_end[1].phase: must be above that of the end before"),
        ("[[phase_end]]\nat_s = 0.04\n".to_owned(), "phase_end[0]"),
    ] {
        says(run(&ends), 2, &[part]);
        says(palpate(folder.path(), &["check", "liver", "script.toml", "--exercise", "two.toml"]), 2, &[part]);
    }
}

#[test]
fn check_warns_of_a_phase_without_time_and_of_a_file_of_another_name() {
    let folder = tempfile::tempdir().unwrap();
    let checked = |limit_s: f64, file: &str| {
        let exercise = format!(
            "name = \"two\"\ninstructions = \"Look, and press.\"\nscenes = [\"liver\"]\ntime_limit_s = {limit_s}\n\
             [[phase]]\ntitle = \"Look\"\ninstructions = \"Look.\"\ntime_limit_s = 20.0\n[[phase]]\ntitle = \"Press\"\ninstructions = \"Press.\"\n\
             [[criterion]]\nmeasure = \"time_s\"\npoor = 30.0\ngood = 20.0\n"
        );
        std::fs::write(folder.path().join(file), exercise).unwrap();
        palpate(folder.path(), &["check", "liver", "--exercise", file])
    };
    let (status, text) = checked(21.0, "two.toml");
    assert!(status == 0 && !text.contains("warning"), "{text}");
    says(checked(20.0, "two.toml"), 0, &["phase 2 begins only if", "may take 20 s, and the time limit is 20 s"]);
    says(checked(21.0, "other.toml"), 0, &["exercise two: its file is other.toml: a server leaves out"]);
}

/// A table of a press on a sheet, as the product simulates it.
fn measured(sets: &[&str]) -> String {
    use palpate_session::press::ImposedPress;
    use std::fmt::Write;
    let model = palpate_tissue::Model::parse("sheet", SHEET, sets).unwrap();
    let time_s: Vec<f64> = (0..=50).map(|k| 0.01 * f64::from(k)).collect();
    let press = ImposedPress {
        place_m: None,
        shape: palpate_haptics::TipShape::Disc,
        radius_m: 0.02,
        depth_m: time_s.iter().map(|time_s| 0.01 * time_s).collect(),
        time_s,
    };
    let limits = palpate_tissue::limits::Limits::default();
    let forces_n = press.forces_n(&model, &limits, &std::sync::atomic::AtomicBool::new(false)).unwrap();
    let mut text = "# a machine in a cellar\nTime (ms),Depth (mm),Force (mN)\n".to_owned();
    for (k, force_n) in forces_n.iter().enumerate() {
        // A noise of 2 % of the largest force.
        let noise_n = if k % 2 == 0 { 0.02 } else { -0.02 } * forces_n[50];
        let [time_s, depth_m, force_n] = [press.time_s[k], press.depth_m[k], force_n + noise_n];
        writeln!(text, "{},{},{}", 1e3 * time_s, 1e3 * depth_m, 1e3 * force_n).unwrap();
    }
    text
}

/// A sheet on soft ground.
const SHEET: &str = "name = \"sheet\"   # of ours\n[sheet]\npoints = [17, 17]\nspacing_m = 0.005\npoint_mass_kg = 1e-4\n[springs]\n\
                     stiffness_n_per_m = 10.0\n[anchor_springs]\nstiffness_n_per_m = 2.0   # a guess\n[damping]\n\
                     coefficient_n_s_per_m = 0.02\n[stepping]\ntolerance = 1e-3\n";

#[test]
fn a_fit_gives_back_the_stiffness_and_writes_a_scene_that_has_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("sheet.toml"), SHEET).unwrap();
    std::fs::write(at("lab.csv"), measured(&["anchor_springs.stiffness_n_per_m=5.0"])).unwrap();
    let anchor = "anchor_springs.stiffness_n_per_m";
    let fit = |further: &[&str]| {
        let arguments =
            [&["fit", "lab.csv", "sheet.toml", "--radius-mm", "20", "--parameter", anchor], further].concat();
        palpate(folder.path(), &arguments)
    };
    says(fit(&["--output", "fitted.toml", "--plot", "fit.svg"]), 0, &[anchor, "95 % interval", "residual", "runs"]);
    let fitted = std::fs::read_to_string(at("fitted.toml")).unwrap();
    for part in [
        "# Fitted to lab.csv (1 curve, 51 samples)",
        "# Curves: a machine in a cellar",
        "name = \"sheet\"   # of ours",
        "# a guess",
    ] {
        assert!(fitted.contains(part), "`{part}` is not in {fitted}");
    }
    let scene = palpate_tissue::scene::Scene::load(&at("fitted.toml"), &[], &palpate_tissue::limits::Limits::default());
    let found = scene.unwrap().anchor_stiffness_n_per_m;
    assert!((found / 5.0 - 1.0).abs() < 0.02, "{found}");
    assert!(std::fs::read_to_string(at("fit.svg")).unwrap().contains("<polyline"));
    let (status, text) = fit(&["--json", "--threads", "1"]);
    let told: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((status, told["parameters"][0]["name"].as_str()), (0, Some(anchor)));
    assert!((told["parameters"][0]["value"].as_f64().unwrap() / found - 1.0).abs() < 1e-5, "{told}");
    // A slow press says nothing of damping.
    let damping = "damping.coefficient_n_s_per_m";
    says(fit(&["--parameter", damping]), 2, &[damping, "the curves can't tell it", "What tells it: presses at speeds"]);
    says(
        fit(&["--parameter", "springs.stifness_n_per_m"]),
        2,
        &["--parameter", "did you mean `springs.stiffness_n_per_m`?"],
    );
    says(fit(&["--parameter", "material.poissons_ratio"]), 2, &["is none of this tissue's parameters"]);
    std::fs::write(at("lab.csv"), "time_s,depth_mm,force_lb\n").unwrap();
    says(fit(&[]), 2, &["lab.csv:1: force_lb: unknown unit `lb`"]);
}
