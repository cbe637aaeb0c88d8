//! What people mistype: each client says what is wrong and what would be right.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::path::Path;
use std::process::Command;

/// Exit status, and both outputs.
fn client(arguments: &[&str]) -> (i32, String) {
    let program = env!("CARGO_BIN_EXE_palpate-client");
    let output = Command::new(program).args(arguments).env_remove("PALPATE_TOKEN").output().unwrap();
    let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    (output.status.code().unwrap(), text)
}

fn says((status, text): (i32, String), expected: i32, part: &str) {
    assert!(status == expected && text.contains(part), "{status}: `{part}` is not in {text}");
}

#[test]
fn clients_name_their_server_alike() {
    let nobody = "http://127.0.0.1:1";
    for program in ["top", "health"] {
        says(client(&[program, "--server", nobody]), 1, "can't reach http://127.0.0.1:1");
        says(client(&[program, nobody]), 1, "can't reach http://127.0.0.1:1");
        says(client(&[program, nobody, "--server", nobody]), 2, "cannot be used with");
    }
    says(client(&["admin", "callers", "--server", nobody]), 1, "can't reach http://127.0.0.1:1");
    // Credentials stand where the server does, before or after what is asked.
    let named = ["--server", "https://127.0.0.1:1", "--tls-name", "name"];
    for asked in [["admin", "callers"], ["cluster", "nodes"]] {
        says(client(&[&asked[..], &named].concat()), 1, "can't reach https://127.0.0.1:1");
        says(client(&[&asked[..1], &named, &asked[1..]].concat()), 1, "can't reach https://127.0.0.1:1");
    }
}

#[cfg(unix)]
#[test]
fn what_has_no_end_is_no_file_of_a_token() {
    let server = ["health", "--server", "http://127.0.0.1:1"];
    for option in ["--token-file", "--ca"] {
        says(client(&[&server[..], &[option, "/dev/zero"]].concat()), 2, "/dev/zero: is larger than the limit");
    }
    says(client(&["play", "/dev/zero"]), 2, "/dev/zero: is not a regular file");
}

#[test]
fn a_wrong_value_is_refused_for_its_reason() {
    let junk = Path::new(env!("CARGO_TARGET_TMPDIR")).join("junk.pem");
    std::fs::write(&junk, "v 0 0 0\n").unwrap();
    let junk = junk.to_str().unwrap();
    says(client(&["link", "--rtt-ms", "-5"]), 2, "--rtt-ms: must be from 0 to 10000, but is -5");
    says(client(&["load", "--sessions", "-5"]), 2, "-5 is not in 1..");
    says(client(&["bridge", "--tool", "first"]), 2, "--tool");
    let secure = ["health", "--server", "https://127.0.0.1:1"];
    says(client(&[&secure[..], &["--ca", junk]].concat()), 2, "--ca: has no certificate in PEM");
    says(client(&[&secure[..], &["--cert", junk, "--key", junk]].concat()), 2, "--cert: has no certificate in PEM");
}
