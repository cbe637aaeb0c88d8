//! libpalpate from C, C++ and C#: the examples against a real server, errors, and the same forces in every language,
//! bit by bit.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

mod course;
#[path = "../common/server.rs"]
mod server;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use server::TestServer;
use tokio::sync::Semaphore;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Tests at a time: forces at a thousand a second need part of a core.
static TURNS: Semaphore = Semaphore::const_new(2);

/// Where everything is installed and compiled.
fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("abi")
}

/// What `make install` puts below a prefix.
fn prefix() -> &'static Path {
    static PREFIX: OnceLock<PathBuf> = OnceLock::new();
    PREFIX.get_or_init(|| {
        // The library is linked into this test too, so cargo has built it.
        let built = std::env::current_exe().unwrap().parent().unwrap().parent().unwrap().to_owned();
        let prefix = folder().join("prefix");
        let _ = std::fs::remove_dir_all(&prefix);
        done(Command::new("sh").arg(root().join("contrib/install.sh")).args([&prefix, &built]));
        prefix
    })
}

/// Runs a command that must end well.
fn done(command: &mut Command) -> Output {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let [out, err] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{err}", output.status);
    output
}

/// Whether a program is there. What needs it is left out else, and this says so.
fn has(program: &str, package: &str) -> bool {
    let is_there = Command::new(program).arg("--version").output().is_ok();
    if !is_there {
        eprintln!("SKIPPED: there is no {program} (Debian: apt-get install {package})");
    }
    is_there
}

/// A program of ours, with the library to be found.
fn ours(program: &Path) -> Command {
    let mut command = Command::new(program);
    command.env("LD_LIBRARY_PATH", prefix().join("lib"));
    command
}

/// Compiles a file of C or C++, by what pkg-config says.
fn compiled(source: &str, more: &[&str]) -> PathBuf {
    let is_c = source.ends_with(".c");
    let name = source.replace(['/', '.'], "-") + &more.concat().replace(['/', '='], "");
    let program = folder().join(name);
    let said = done(
        Command::new("pkg-config")
            .args(["--cflags", "--libs", "palpate"])
            .env("PKG_CONFIG_PATH", prefix().join("lib/pkgconfig")),
    );
    let flags = String::from_utf8(said.stdout).unwrap();
    let mut compiler = Command::new(if is_c { "cc" } else { "c++" });
    compiler.args(["-Wall", "-Wextra", "-Wpedantic", "-Werror", if is_c { "-std=c99" } else { "-std=c++17" }]);
    compiler.arg(root().join(source)).arg("-o").arg(&program).args(flags.split_whitespace());
    done(compiler.args(["-lm", "-lpthread"]).args(more));
    program
}

/// The last line that a program printed, as JSON.
fn told(output: &Output) -> serde_json::Value {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let line = text.lines().last().unwrap_or_else(|| panic!("{output:?}"));
    serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))
}

/// Checks the output of an example for a press of 3 mm into liver for two seconds.
fn assert_pressed(output: &Output, is_ticked_by_it: bool) {
    let told = told(output);
    let ticks = told["ticks"].as_u64().unwrap();
    assert!(if is_ticked_by_it { ticks == 2000 } else { ticks > 500 }, "{told}");
    let most_n = told["force_max_n"].as_f64().unwrap();
    assert!((0.05..3.3).contains(&most_n), "{told}");
}

/// Checks the output of an example for a surface at rest.
fn assert_looked(output: &Output, heights: &str) {
    let told = told(output);
    assert_eq!((told["vertices"].as_u64(), told["triangles"].as_u64()), (Some(961), Some(1800)), "{told}");
    assert!(told["frames"].as_u64().unwrap() >= 1, "{told}");
    assert!(told[heights].as_array().unwrap().iter().all(|z_m| z_m.as_f64().unwrap().abs() < 1e-3), "{told}");
}

/// Checks the output of an example in which two hands press liver with a grasper each.
fn assert_both_hands_felt(output: &Output, min_torque_n_m: f64) {
    let told = told(output);
    // Two jaws and a shaft: rows of tips.
    assert!((8..30).contains(&told["tools"].as_u64().unwrap()), "{told}");
    for hand in 0..2 {
        assert!((0.05..3.3).contains(&told["force_max_n"][hand].as_f64().unwrap()), "{told}");
        let torque_n_m = told["torque_max_n_m"][hand].as_f64().unwrap();
        assert!((min_torque_n_m..0.11).contains(&torque_n_m), "{told}");
        assert!(told["force_at_end_n"][hand].as_f64().is_none_or(|force_n| force_n == 0.0), "{told}");
    }
}

/// A folder with the scene `liver`, whose anchor springs can be severed here.
fn anchored_liver() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let liver = std::fs::read_to_string(root().join("scenes/liver.toml")).unwrap();
    let anchored = liver.replace("[cutting]", "[cutting]\nanchor_depth_m = 0.003\n#");
    assert_ne!(anchored, liver);
    std::fs::write(folder.path().join("liver.toml"), anchored).unwrap();
    folder
}

/// Checks an example that cuts liver along 30 mm, twelve springs of 2.5 mm, sews it by a thread of 20 mm, and burns a place through.
fn assert_cuts_sews_and_burns(program: &mut Command) {
    let scenes = anchored_liver();
    let server = TestServer::start(&["--scenes", scenes.path().to_str().unwrap()]);
    let told = told(&done(program.args([server.url.as_str(), "liver"])));
    assert!(told["severed"].as_u64().unwrap() >= 24 && told["pieces"].as_u64() == Some(1), "{told}");
    assert!(told["version"].as_u64().unwrap() > 1, "{told}");
    let (thread_m, tension_n) = (told["thread_m"].as_f64().unwrap(), told["tension_n"].as_f64().unwrap());
    assert!((0.019..0.021).contains(&thread_m) && tension_n > 1e-3, "{told}");
    // A disc of 3 mm reaches some of the points, which are 2.5 mm apart, and with each its anchor goes.
    let (burnt, anchors) = (told["burnt"].as_u64().unwrap(), told["anchors"].as_u64().unwrap());
    assert!((1..=16).contains(&burnt) && anchors >= burnt, "{told}");
}

const RUN: [&str; 2] = ["liver", "2"];

/// The examples with two hands end when both have felt the tissue.
const RUN_UNTIL_FELT: [&str; 2] = ["liver", "60"];

#[tokio::test]
async fn examples_in_c_press_look_and_connect_a_device() {
    let _turn = TURNS.acquire().await.unwrap();
    let server = TestServer::start(&[]);
    let run = |program: &Path| done(ours(program).arg(&server.url).args(RUN));
    let touch = compiled("clients/c/examples/touch.c", &[]);
    let output = run(&touch);
    assert_pressed(&output, true);
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 1, "exactly one line");
    assert_looked(&run(&compiled("clients/c/examples/look.c", &[])), "z_m");
    let output = run(&compiled("clients/c/examples/device.c", &[]));
    assert_pressed(&output, false);
    let told = told(&output);
    assert_eq!(told["force_at_end_n"].as_f64(), Some(0.0), "{told}");
    assert!(["real time", "refused"].contains(&told["priority"].as_str().unwrap()), "{told}");
    let hands = compiled("clients/c/examples/hands.c", &[]);
    assert_both_hands_felt(&done(ours(&hands).arg(&server.url).args(RUN_UNTIL_FELT)), 1e-4);
    assert_cuts_sews_and_burns(&mut ours(&compiled("clients/c/examples/cut.c", &[])));
    // Wrong names end with a message and a status.
    for (url, scene) in [("http://127.0.0.1:1", "liver"), (server.url.as_str(), "nowhere")] {
        let refused = ours(&touch).args([url, scene, "1"]).output().unwrap();
        assert_eq!(refused.status.code(), Some(1));
        assert!(refused.stdout.is_empty() && !refused.stderr.is_empty(), "{refused:?}");
    }
    assert_eq!(ours(&touch).arg(&server.url).output().unwrap().status.code(), Some(2));
}

/// On an organ the middle of the tissue is inside it.
#[tokio::test]
async fn the_touch_of_the_example_finds_the_surface_of_a_mesh_and_is_in_the_static_library() {
    let _turn = TURNS.acquire().await.unwrap();
    let server = TestServer::start(&[]);
    let archive = prefix().join("lib/libpalpate.a");
    let program = folder().join("touch-static");
    let mut compiler = Command::new("cc");
    compiler.arg(root().join("clients/c/examples/touch.c")).arg("-I").arg(prefix().join("include"));
    done(compiler.arg(archive).arg("-o").arg(&program).args(["-lm", "-lpthread", "-ldl", "-lrt", "-lgcc_s"]));
    for scene in ["liver", "gallbladder"] {
        assert_pressed(&done(Command::new(&program).args([server.url.as_str(), scene, "2"])), true);
    }
}

#[tokio::test]
async fn what_is_wrong_in_c_is_an_error_with_words() {
    let _turn = TURNS.acquire().await.unwrap();
    let server = TestServer::start(&[]);
    done(ours(&compiled("clients/c/tests/errors.c", &[])).arg(&server.url));
}

#[tokio::test]
async fn examples_in_cpp_press_look_and_show() {
    if !has("c++", "g++") {
        return;
    }
    let _turn = TURNS.acquire().await.unwrap();
    let server = TestServer::start(&[]);
    let run = |program: &Path| done(ours(program).arg(&server.url).args(RUN));
    assert_looked(&run(&compiled("clients/cpp/examples/look.cpp", &["-fno-exceptions"])), "z_m");
    // In a port only the turn about the shaft is felt as a torque.
    let hands = compiled("clients/cpp/examples/hands.cpp", &[]);
    assert_both_hands_felt(&done(ours(&hands).arg(&server.url).args(RUN_UNTIL_FELT)), 0.0);
    assert_cuts_sews_and_burns(&mut ours(&compiled("clients/cpp/examples/cut.cpp", &[])));
    // The others by the CMake package, where there is CMake.
    let built = folder().join("cmake");
    let program = |name: &str| built.join(name);
    if has("cmake", "cmake") {
        let _ = std::fs::remove_dir_all(&built);
        let package = format!("-DCMAKE_PREFIX_PATH={}", prefix().display());
        let sources = root().join("clients/cpp/examples");
        done(Command::new("cmake").arg("-S").arg(sources).arg("-B").arg(&built).arg(package));
        done(Command::new("cmake").arg("--build").arg(&built));
        assert_pressed(&run(&program("touch")), true);
        assert_pressed(&run(&program("front_end")), false);
    } else {
        assert_pressed(&run(&compiled("clients/cpp/examples/touch.cpp", &[])), true);
        assert_pressed(&run(&compiled("clients/cpp/examples/front_end.cpp", &[])), false);
    }
}

/// Compiles a file of C# with the library's.
fn compiled_cs(source: &str) -> PathBuf {
    let program = folder().join(Path::new(source).with_extension("exe").file_name().unwrap());
    let out = format!("-out:{}", program.display());
    let mut compiler = Command::new("mcs");
    compiler.args(["-warnaserror", &out]).arg(prefix().join("share/palpate/Palpate.cs"));
    done(compiler.arg(root().join(source)));
    program
}

fn has_mono() -> bool {
    has("mono", "mono-runtime") && has("mcs", "mono-mcs")
}

fn mono(program: &Path) -> Command {
    let mut command = ours(Path::new("mono"));
    command.arg(program);
    command
}

#[tokio::test]
async fn examples_in_cs_press_look_and_show() {
    if !has_mono() {
        return;
    }
    let _turn = TURNS.acquire().await.unwrap();
    let server = TestServer::start(&[]);
    let run = |program: &Path| done(mono(program).arg(&server.url).args(RUN));
    assert_looked(&run(&compiled_cs("clients/csharp/examples/Look.cs")), "y_m");
    assert_pressed(&run(&compiled_cs("clients/csharp/examples/TouchIt.cs")), true);
    assert_pressed(&run(&compiled_cs("clients/csharp/examples/FrontEnd.cs")), false);
    let hands = compiled_cs("clients/csharp/examples/Hands.cs");
    assert_both_hands_felt(&done(mono(&hands).arg(&server.url).args(RUN_UNTIL_FELT)), 1e-4);
    assert_cuts_sews_and_burns(&mut mono(&compiled_cs("clients/csharp/examples/Cut.cs")));
    done(mono(&compiled_cs("clients/csharp/tests/Errors.cs")).arg(&server.url));
}

/// Front ends are at most this long.
#[test]
fn a_whole_front_end_has_at_most_sixty_lines() {
    for file in ["clients/cpp/examples/front_end.cpp", "clients/csharp/examples/FrontEnd.cs"] {
        let lines = std::fs::read_to_string(root().join(file)).unwrap().lines().count();
        assert!(lines <= 60, "{file}: {lines}");
    }
}
