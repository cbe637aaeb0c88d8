//! Scene and script files, and `palpate run`: what is read, what is refused, what is written.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

const SCENE: &str = r#"name = "test"

[sheet]
points = [9, 7]
spacing_m = 0.05
point_mass_kg = 0.01

[springs]
stiffness_n_per_m = 20.0

[anchor_springs]
stiffness_n_per_m = 5.0

[damping]
coefficient_n_s_per_m = 0.3
"#;

const SCRIPT: &str = r#"name = "test"
duration_s = 0.1
sample_every_s = 0.05

[[force]]
point = [4, 3]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 60.0
falloff_offset = 0.0
profile = { type = "constant" }
"#;

/// `palpate run` on texts.
fn run_in(folder: &Path, scene: &str, script: &str, more: &[&str]) -> Output {
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    std::fs::write(folder.join("script.toml"), script).unwrap();
    Command::new(env!("CARGO_BIN_EXE_palpate"))
        .args(["run", "scene.toml", "script.toml"])
        .args(more)
        .current_dir(folder)
        .output()
        .unwrap()
}

fn run(scene: &str, script: &str, more: &[&str]) -> Output {
    run_in(tempfile::tempdir().unwrap().path(), scene, script, more)
}

fn lines(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[track_caller]
fn refused(output: &Output, expected: &[&str]) {
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(output.stdout.is_empty(), "something was written");
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn a_run_writes_a_header_records_and_a_summary() {
    let script = SCRIPT.to_owned()
        + "[[tool]]\npoint = [1, 1]\nmoves = [{ from_s = 0.0, to_s = 0.1, by_m = [0.0, 0.0, -0.01] }]\n";
    let lines = lines(&run(SCENE, &script, &[]));
    assert_eq!(lines.len(), 5);
    let header = &lines[0]["run"];
    assert_eq!((&header["scene"], &header["script"]), (&"test".into(), &"test".into()));
    assert_eq!((&header["integrator"], &header["precision"]), (&"exponential4".into(), &"f32".into()));
    assert_eq!((&header["substeps"], &header["rate_hz"]), (&1.into(), &1000.0.into()));
    assert!(header["version"].is_string());
    for (index, record) in lines[1..4].iter().enumerate() {
        assert_eq!(record["time_s"].as_f64().unwrap(), 0.05 * index as f64);
        assert_eq!(record["awake_points"], 63);
        for energy in ["kinetic", "spring", "virtual"] {
            assert!(record["energy_j"][energy].is_f64());
        }
        // The control points are the default sample points: the force's, then the tool's.
        let [pushed, grasped] = record["points"].as_array().unwrap().as_slice() else { panic!() };
        assert_eq!((&pushed["point"], &grasped["point"]), (&serde_json::json!([4, 3]), &serde_json::json!([1, 1])));
        for key in
            ["displacement_m", "velocity_m_per_s", "spring_n", "anchor_n", "damping_n", "applied_n", "reaction_n"]
        {
            assert_eq!(pushed[key].as_array().unwrap().len(), 3);
        }
        assert!(pushed.get("constraint_n").is_none() && grasped["constraint_n"].is_array());
        assert_eq!(pushed["applied_n"][2], -1.0);
    }
    let summary = &lines[4]["summary"];
    assert_eq!((&summary["steps"], &summary["substeps"]), (&100.into(), &100.into()));
    assert_eq!((&summary["points"], &summary["guard_events"]), (&63.into(), &0.into()));
    assert_eq!(summary["computed_fraction"], 1.0);
    assert!(summary["wall_s"].as_f64().unwrap() > 0.0 && summary["ns_per_point_substep"].as_f64().unwrap() > 0.0);
    assert_eq!(summary["final_hash"].as_str().unwrap().len(), 32);
}

#[test]
fn set_takes_toml_values_and_bare_strings() {
    let sets = ["--set", "stepping.integrator=lagged", "--set", "stepping.substeps=4", "--set", "sheet.points=[5, 7]"];
    let more = ["--set", "stepping.precision=\"f64\"", "--set", "name=other", "--set", "sheet.fixed=edges"];
    let output = lines(&run(SCENE, SCRIPT, &[&sets[..], &more[..]].concat()));
    let header = &output[0]["run"];
    assert_eq!((&header["integrator"], &header["substeps"]), (&"lagged".into(), &4.into()));
    assert_eq!((&header["precision"], &header["scene"]), (&"f64".into(), &"other".into()));
    assert_eq!((&output[1]["awake_points"], &output[2]["awake_points"]), (&0.into(), &35.into()));
    for (set, expected) in [
        ("stepping.integrator=magic", "--set: stepping.integrator: must be one of auto, central, lagged"),
        ("stepping.integratr=central", "--set: stepping.integratr: unknown key"),
        ("stepping.substeps=some", "--set: stepping.substeps"),
        ("sheet.spacing_m=-1", "--set: sheet.spacing_m: must be above 0"),
        ("nonsense", "must be key=value"),
        ("sheet..points=1", "empty part"),
        ("sheet.points.x=1", "--set"),
    ] {
        refused(&run(SCENE, SCRIPT, &["--set", set]), &[expected]);
    }
}

#[test]
fn a_bad_scene_is_refused_with_file_line_and_key() {
    for (from, to, expected) in [
        ("spacing_m = 0.05", "spacing_m = -1.0", "scene.toml:5: sheet.spacing_m: must be above 0"),
        ("spacing_m = 0.05", "spacing_m = nan", "scene.toml:5: sheet.spacing_m: must be a finite number"),
        ("spacing_m = 0.05", "spacing_m = inf", "scene.toml:5: sheet.spacing_m: must be a finite number"),
        ("spacing_m = 0.05", "spacing_m = \"wide\"", "scene.toml:5: sheet.spacing_m: must be a number"),
        (
            "spacing_m = 0.05",
            "spacing = 0.05",
            "scene.toml:5: sheet.spacing: unknown key: the unit belongs to the name",
        ),
        ("spacing_m = 0.05", "spacing_m = 0.05\ncolour = 1", "scene.toml:6: sheet.colour: unknown key"),
        ("spacing_m = 0.05\n", "", "scene.toml:3: sheet.spacing_m: is missing"),
        ("spacing_m = 0.05", "spacingm = 0.05", "scene.toml:5: sheet.spacingm: unknown key; did you mean `spacing_m`?"),
        ("points = [9, 7]", "points = [0, 7]", "scene.toml:4: sheet.points: must be at least 1"),
        ("points = [9, 7]", "points = [1000000000, 1]", "scene.toml:4: sheet.points"),
        ("points = [9, 7]", "points = [9, 7, 1]", "scene.toml:4: sheet.points: must be a list of two"),
        ("points = [9, 7]", "points = [9.5, 7]", "scene.toml:4: sheet.points[0]: must be a whole number, but is 9.5"),
        ("points = [9, 7]", "points = [61.0, 7]", "sheet.points[0]: must be a whole number, but is 61.0: write 61"),
        ("spacing_m = 0.05", "spacing_m = \"0.05\"", "must be a number, but is a string: write 0.05 without"),
        ("[anchor_springs]", "[anchor]", "anchor: unknown key; did you mean `anchor_springs`?"),
        ("[springs]", "[spring]", "scene.toml:8: spring: unknown key; did you mean `springs`?"),
        ("[springs]", "fixed = \"edge\"\n[springs]", "but is `edge`; did you mean `edges`?"),
        ("[damping]", "[stepping]\nintegrator = \"centrl\"\n[damping]", "but is `centrl`; did you mean `central`?"),
        ("points = [9, 7]", "points = [-9, 7]", "scene.toml:4: sheet.points[0]: must be 0 or more"),
        ("[damping]", "[friction]", "scene.toml:1: damping: is missing"),
        ("[damping]", "[friction]\n[damping]", "scene.toml:14: friction: unknown key; known here: name, sheet"),
        ("[damping]", "[damping", "scene.toml:14"),
        ("coefficient_n_s_per_m = 0.3", "coefficient_n_s_per_m = -0.3", "scene.toml:15: damping.coefficient_n_s_per_m"),
        ("[damping]", "[stepping]\nrate_hz = 0.0\n[damping]", "scene.toml:15: stepping.rate_hz: must be from 1e-3"),
        ("[damping]", "[stepping]\nsubsteps = 0\n[damping]", "scene.toml:15: stepping.substeps"),
        ("[damping]", "[stepping]\ntolerance = 0.0\n[damping]", "scene.toml:15: stepping.tolerance"),
        ("[damping]", "[sleep]\ntolerance = 2.0\n[damping]", "scene.toml:15: sleep.tolerance"),
        ("[springs]", "fixed = [[9, 0]]\n[springs]", "scene.toml:8: sheet.fixed[0]: [9, 0] is not on the sheet"),
        ("[springs]", "fixed = \"middle\"\n[springs]", "scene.toml:8: sheet.fixed"),
    ] {
        assert!(SCENE.contains(from));
        refused(&run(&SCENE.replacen(from, to, 1), SCRIPT, &[]), &[expected]);
    }
}

#[test]
fn a_bad_script_is_refused_with_file_line_and_key() {
    let profile = "profile = { type = \"constant\" }";
    for (from, to, expected) in [
        ("duration_s = 0.1", "duration_s = 0.0", "script.toml:2: duration_s: must be above 0"),
        ("duration_s = 0.1", "duration_s = inf", "script.toml:2: duration_s"),
        ("sample_every_s = 0.05", "sample_every_s = 0.0001", "script.toml:3: sample_every_s: is less than half a step"),
        ("point = [4, 3]", "point = [9, 3]", "script.toml:6: force[0].point: [9, 3] is not on the sheet"),
        ("[[force]]", "[force]", "script.toml:5: force: must be a list, but is a table: write [[force]]"),
        ("point = [4, 3]\n", "", "script.toml:5: force[0]: must have just one of"),
        (
            "point = [4, 3]",
            "point = [4, 3]\npath = { from_m = [0.0, 0.0], velocity_m_per_s = [0.0, 0.0] }",
            "just one of",
        ),
        ("point = [4, 3]", "hops = []", "script.toml:6: force[0].hops"),
        (
            "point = [4, 3]",
            "hops = [{ at_s = 0.1, point = [1, 1] }, { at_s = 0.0, point = [2, 1] }]",
            "script.toml:6: force[0].hops: at_s of entry 1 is before",
        ),
        (
            "point = [4, 3]",
            "path = { from_m = [9.0, 0.0], velocity_m_per_s = [0.0, 0.0] }",
            "script.toml:6: force[0].path.from_m: (9, 0, 0) m is off the tissue, which is 0.4 m × 0.3 m",
        ),
        ("force_n = [0.0, 0.0, -1.0]", "force_n = [0.0, nan, -1.0]", "script.toml:7: force[0].force_n[1]"),
        ("force_n = [0.0, 0.0, -1.0]", "force_n = [0.0, 0.0, -2e4]", "script.toml:7: force[0].force_n: is 2.0"),
        ("falloff_offset = 0.0", "falloff_offset = 10.0", "above the limit of 10000 N"),
        ("falloff_per_m = 60.0", "falloff_per_m = -1.0", "script.toml:8: force[0].falloff_per_m"),
        ("falloff_per_m = 60.0", "falloff = 60.0", "script.toml:8: force[0].falloff: unknown key"),
        (profile, "profile = { type = \"puls\" }", "but is `puls`; did you mean `pulse`?"),
        (profile, "profile = { type = \"pulse\", on_s = 0.1 }", "force[0].profile.off_s: is missing"),
        (profile, "profile = { type = \"wave\" }", "force[0].profile.type: must be one of constant, pulse"),
        (profile, "profile = { type = \"constant\", on_s = 1.0 }", "force[0].profile.on_s: unknown key"),
        (profile, "profile = { type = \"pulse\", on_s = 0.2, off_s = 0.1 }", "force[0].profile.off_s"),
        (profile, "profile = { type = \"ramp\", from_s = 0.2, to_s = 0.1 }", "force[0].profile.to_s"),
        (
            profile,
            "profile = { type = \"sine\", frequency_hz = 1e308 }",
            "force[0].profile.frequency_hz: must be from 0",
        ),
        (profile, "profile = { type = \"sine\", frequency_hz = -1.0 }", "force[0].profile.frequency_hz"),
        (
            profile,
            "profile = { type = \"trace\", file = \"none.csv\" }",
            "force[0].profile.file: none.csv can't be opened",
        ),
        (
            profile,
            &format!(
                "{profile}\n[[tool]]\npoint = [1, 1]\nmoves = [{{ from_s = 0.1, to_s = 0.1, by_m = [0.0, 0.0, 0.0] }}]"
            ),
            "tool[0].moves[0].to_s",
        ),
        (
            profile,
            &format!(
                "{profile}\n[[tool]]\npoint = [1, 1]\nmoves = [{{ from_s = 0.0, to_s = 0.1, by_m = [0.0, 0.0, 1e9] }}]"
            ),
            "tool[0].moves",
        ),
        ("sample_every_s = 0.05", "sample_every_s = 0.05\nsample_points = [[0, 7]]", "script.toml:4: sample_points[0]"),
        (profile, &format!("{profile}\n[[tissue]]\nat_s = 0.05"), "tissue[0]: names nothing to change"),
        (
            profile,
            &format!("{profile}\n[[tissue]]\nat_s = 0.05\nstiffness_n_per_m = -1.0"),
            "tissue[0]: springs.stiffness_n_per_m: must be 0 or more",
        ),
        (
            profile,
            &format!(
                "{profile}\n[[tissue]]\nat_s = 0.05\ndamping_n_s_per_m = 1.0\n[[tissue]]\nat_s = 0.05\ndamping_n_s_per_m = 2.0"
            ),
            "tissue[1].at_s: must be later",
        ),
    ] {
        assert!(SCRIPT.contains(from));
        refused(&run(SCENE, &SCRIPT.replacen(from, to, 1), &[]), &[expected]);
    }
}

#[test]
fn a_trace_is_read_row_by_row_and_refused_by_line() {
    let folder = tempfile::tempdir().unwrap();
    let script = SCRIPT.replace("{ type = \"constant\" }", "{ type = \"trace\", file = \"trace.csv\" }");
    let trace = |text: &str| {
        std::fs::write(folder.path().join("trace.csv"), text).unwrap();
        run_in(folder.path(), SCENE, &script, &[])
    };
    let good = lines(&trace("time_s,fx_n,fy_n,fz_n\r\n0.01,0,0,-0.5\r\n0.05, 0.25, 0, -0.75\r\n"));
    let applied: Vec<_> =
        good[1..4].iter().map(|record| record["points"][0]["applied_n"][2].as_f64().unwrap()).collect();
    // Held between rows; nothing before the first; a record at a jump shows the force before it.
    assert_eq!(applied, [0.0, -0.5, -0.75]);
    for (text, expected) in [
        ("time,x,y,z\n", "trace.csv:1: must begin with the line"),
        ("time_s,fx_n,fy_n,fz_n\n", "has no rows"),
        ("time_s,fx_n,fy_n,fz_n\n0,1,2\n", "trace.csv:2: must have the 4 columns"),
        ("time_s,fx_n,fy_n,fz_n\n0,1,2,x\n", "trace.csv:2: `x` is not a finite number"),
        ("time_s,fx_n,fy_n,fz_n\n0,1,2,NaN\n", "trace.csv:2"),
        ("time_s,fx_n,fy_n,fz_n\n0.01,1,2,3\n0.01,1,2,3\n", "trace.csv:3: time_s must rise"),
        ("time_s,fx_n,fy_n,fz_n\n0,0,0,2e4\n", "above the limit of 10000 N"),
    ] {
        refused(&trace(text), &[expected]);
    }
    // A file of a gigabyte is refused by its size, before it is read.
    let huge = std::fs::File::create(folder.path().join("trace.csv")).unwrap();
    huge.set_len(1 << 30).unwrap();
    refused(&run_in(folder.path(), SCENE, &script, &[]), &["force[0].profile.file", "larger than the limit"]);
}

#[test]
fn times_between_steps_are_rounded_with_a_warning() {
    let script = SCRIPT.replace("{ type = \"constant\" }", "{ type = \"pulse\", on_s = 0.0204, off_s = 1.0 }");
    let output = run(SCENE, &script, &[]);
    let warning = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(warning.contains("force[0].profile.on_s: 0.0204 s is not a whole number of steps; taken as 0.02 s"));
    let script = SCRIPT.replace("{ type = \"constant\" }", "{ type = \"pulse\", on_s = 0.02, off_s = 1.0 }");
    let exact = run(SCENE, &script, &[]);
    assert!(exact.stderr.is_empty());
    let hash = |output: &Output| lines(output).pop().unwrap()["summary"]["final_hash"].clone();
    assert_eq!(hash(&output), hash(&exact));
}

#[test]
fn coefficients_of_zero_are_valid() {
    let zeros = SCENE.replace("= 20.0", "= 0.0").replace("= 5.0", "= 0.0").replace("= 0.3", "= 0");
    let lines = lines(&run(&zeros, SCRIPT, &["--set", "stepping.precision=f64"]));
    // A free point of 10 g under 1 N: half of a·t².
    let z = lines[3]["points"][0]["displacement_m"][2].as_f64().unwrap();
    assert!((z + 0.5 * 100.0 * 0.01).abs() < 1e-9, "{z}");
}

#[test]
fn a_run_that_blows_up_fails_and_says_why() {
    let output = run(SCENE, SCRIPT, &["--set", "springs.stiffness_n_per_m=1e9", "--set", "stepping.substeps=1"]);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("warning: stepping.substeps: 1 is above the stability bound"), "{message}");
    assert!(
        message.contains("the guard released all tools after step 4, because point [0, 0] was not finite"),
        "{message}"
    );
    assert!(message.contains("from there on the run differs from the script"), "{message}");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(!text.contains("NaN") && !text.contains("null"), "{text}");
    let summary: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    assert!(!summary["summary"]["recoveries"].as_array().unwrap().is_empty(), "{summary}");
}

#[test]
fn missing_files_and_folders_are_told() {
    let palpate = |arguments: &[&str]| Command::new(env!("CARGO_BIN_EXE_palpate")).args(arguments).output().unwrap();
    refused(&palpate(&["run", "no-scene.toml", "no-script.toml"]), &["no-scene.toml: can't be opened"]);
    refused(&palpate(&["run", "paper", "no-script.toml"]), &["no-script.toml: can't be opened"]);
    let folder = tempfile::tempdir().unwrap();
    refused(&run_in(folder.path(), SCENE, SCRIPT, &["--output", "no/such/file"]), &["no/such/file: can't be written"]);
    let output = run_in(folder.path(), SCENE, SCRIPT, &["--output", "out.jsonl", "--quiet"]);
    assert!(output.status.success() && output.stdout.is_empty());
    let output = run_in(folder.path(), SCENE, SCRIPT, &["--output", "out.jsonl"]);
    assert!(output.status.success() && String::from_utf8_lossy(&output.stdout).contains("final hash"));
    assert_eq!(std::fs::read_to_string(folder.path().join("out.jsonl")).unwrap().lines().count(), 5);
}

#[test]
fn scenes_and_scripts_are_found_by_name() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["scenes", "other", "scripts"] {
        std::fs::create_dir(folder.path().join(name)).unwrap();
    }
    std::fs::write(folder.path().join("scenes/mine.toml"), SCENE).unwrap();
    std::fs::write(folder.path().join("other/mine.toml"), SCENE.replace("\"test\"", "\"other\"")).unwrap();
    std::fs::write(folder.path().join("scripts/mine.toml"), SCRIPT).unwrap();
    let palpate = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_palpate")).args(arguments).current_dir(folder.path()).output().unwrap()
    };
    assert_eq!(lines(&palpate(&["run", "mine", "mine"]))[0]["run"]["scene"], "test");
    assert_eq!(lines(&palpate(&["run", "mine", "mine", "--scenes", "other"]))[0]["run"]["scene"], "other");
    assert_eq!(lines(&palpate(&["run", "paper", "mine"]))[0]["run"]["scene"], "paper");
    refused(
        &palpate(&["run", "yours", "mine"]),
        &[
            "there is no scene `yours`; there are colon, fibrotic, gallbladder, gallbladder-bed, kidney, liver, liver-organ, liver-solid, mine, paper, phantom, prostate, stomach; give your own scene by its path",
        ],
    );
    refused(&palpate(&["run", "liverr", "mine"]), &["there is no scene `liverr`", "; did you mean `liver`?"]);
    refused(
        &palpate(&["run", "paper", "vertcal-60"]),
        &[
            "there is no script `vertcal-60`; there are cut, cut-solid, dissect, grasp, lift, mine, oblique",
            "; did you mean `vertical-60`?",
        ],
    );
    // A file in the folder, whose ending was left out.
    for name in ["firm", "poke"] {
        std::fs::copy(folder.path().join("scenes/mine.toml"), folder.path().join(format!("{name}.toml"))).unwrap();
    }
    let meant = "there are colon, fibrotic, gallbladder, gallbladder-bed, kidney, liver, liver-organ, liver-solid, mine, paper, phantom, prostate, stomach; did you mean the file `firm.toml`?";
    refused(&palpate(&["check", "firm"]), &["there is no scene `firm`", meant]);
    refused(
        &palpate(&["run", "paper", "poke"]),
        &["there is no script `poke`", "; did you mean the file `poke.toml`?"],
    );
    // Built in, without a file of that name.
    assert_eq!(lines(&palpate(&["run", "paper", "vertical-60"]))[0]["run"]["script"], "vertical-60");
}

#[test]
fn a_scene_and_a_script_that_are_swapped_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.toml"), SCENE).unwrap();
    std::fs::write(folder.path().join("script.toml"), SCRIPT).unwrap();
    let palpate = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_palpate")).args(arguments).current_dir(folder.path()).output().unwrap()
    };
    let order = "give the scene first, then the script";
    refused(&palpate(&["run", "script.toml", "scene.toml"]), &["script.toml: is a script: ", order]);
    refused(&palpate(&["run", "paper", "scene.toml"]), &["scene.toml: is a scene: ", order]);
    refused(&palpate(&["run", "vertical-60", "paper"]), &["there is no scene `vertical-60`", "is a script: ", order]);
    refused(&palpate(&["run", "paper", "liver"]), &["there is no script `liver`", "`liver` is a scene: ", order]);
}

/// Returns the output of `palpate check`.
fn checked(folder: &Path, arguments: &[&str]) -> String {
    let mut program = Command::new(env!("CARGO_BIN_EXE_palpate"));
    let output = program.arg("check").args(arguments).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn check_tells_what_to_expect_and_warns_of_what_can_not_be_meant() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let liver = checked(folder, &["liver"]);
    for part in [
        "size          0.075 m × 0.075 m (75 mm × 75 mm), 63.7 g in all",
        "extent        from [0, 0, 0] to [0.075, 0.075, 0],",
        "N/m where a disc of 5 mm radius",
        "rest  ",
    ] {
        assert!(liver.contains(part), "no `{part}` in: {liver}");
    }
    assert!(!liver.contains("warning"), "{liver}");
    // The documentation's stiffness of liver under a flat punch of 5 mm.
    let line = liver.lines().find(|line| line.starts_with("fingertip")).unwrap();
    let stiffness: f64 = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    assert!((60.0..82.0).contains(&stiffness), "{line}");
    let wrong = checked(folder, &["liver", "--set", "sheet.spacing_m=2.5", "--set", "sheet.point_mass_kg=0.6"]);
    assert!(wrong.contains("warning: the sheet is 75 m long, more than 10 m"), "{wrong}");
    assert!(wrong.contains("warning: a point weighs 0.6 kg, more than 0.1 kg"), "{wrong}");
    std::fs::write(folder.join("script.toml"), SCRIPT.replace("-1.0]", "-1000.0]").replace("60.0", "300.0")).unwrap();
    let through = checked(folder, &["liver", "script.toml"]);
    assert!(through.contains("warning: force[0]: ") && through.contains("it goes through"), "{through}");
}

#[test]
fn a_run_that_leaves_its_sheet_warns_at_the_end() {
    let warned = |force: &str| {
        let output = run(SCENE, &SCRIPT.replace("-1.0]", force), &[]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(warned("-1.0]"), "");
    let far = warned("-1000.0]");
    assert!(far.contains("palpate: warning: the largest displacement was "), "{far}");
    assert!(far.contains("more than the tissue's longest side, 0.400 m"), "{far}");
}

#[test]
fn a_run_plots_and_sums_up_where_its_records_do_not_go() {
    let folder = tempfile::tempdir().unwrap();
    let records = folder.path().join("records.jsonl");
    let told = |more: &[&str]| {
        let output = run_in(folder.path(), SCENE, SCRIPT, more);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap())
    };
    let titles = ["Displacement of the control point along z, m\n", "Force of the tissue on the tool along z, N\n"];
    let [out, err] = told(&["--plot"]);
    assert!(out.lines().all(|line| line.starts_with('{')), "{out}");
    assert!(titles.iter().all(|title| err.contains(title)) && !err.contains("final hash"), "{err}");
    let [out, err] = told(&["--plot", "--output", records.to_str().unwrap()]);
    let hash = lines_of(&records).pop().unwrap()["summary"]["final_hash"].as_str().unwrap().to_owned();
    for part in titles.iter().chain(&["steps  ", "largest displacement  ", "peak reaction  ", "final hash  ", &hash]) {
        assert!(out.contains(part), "no `{part}` in: {out}");
    }
    assert_eq!(err, "");
    assert_eq!(told(&["--quiet", "--output", records.to_str().unwrap()]), ["", ""]);
    assert_eq!(told(&["-q"])[1], "");
}

/// The lines of a file of records.
fn lines_of(path: &Path) -> Vec<Value> {
    std::fs::read_to_string(path).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_sheet_of_one_point_is_a_pendulum_and_a_line_is_a_string() {
    for points in ["[1, 1]", "[1, 9]", "[9, 1]", "[2, 2]"] {
        let scene = SCENE.replace("[9, 7]", points);
        let script = SCRIPT.replace("[4, 3]", "[0, 0]");
        let sets = ["--set", "springs.bending=true"];
        let lines = lines(&run(&scene, &script, &sets));
        assert!(lines[3]["points"][0]["displacement_m"][2].as_f64().unwrap() < -0.01, "{points}");
    }
}

#[test]
fn the_pages_on_scenes_scripts_and_records_tell_the_truth() {
    // Their scene and their scripts are read as they stand there.
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs");
    let pages = ["scenes.md", "scripts.md", "records.md"];
    let page = pages.map(|name| std::fs::read_to_string(folder.join(name)).unwrap()).concat();
    let blocks: Vec<&str> = page.split("```toml\n").skip(1).map(|rest| rest.split("```").next().unwrap()).collect();
    let [scene, script, people, ..] = blocks.as_slice() else { panic!("{} blocks", blocks.len()) };
    let liver = palpate_tissue::scene::BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap().1;
    assert_eq!(lines(&run(liver, people, &[])).len(), 1 + 21 + 1);
    let output = run(scene, script, &[]);
    assert_eq!(lines(&output).len(), 1 + 21 + 1);
    // Every key of a record and of a summary is in their tables.
    let through = lines(&output);
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    let point = &through[1]["points"][0];
    for key in [keys(&through[1]), keys(point), keys(&through[22]["summary"]), keys(&through[0]["run"])].concat() {
        assert!(page.contains(&format!("`{key}")) || page.contains(&format!(".{key}")) || page.contains(&key), "{key}");
    }
}
