//! The end of `cargo xtask run`: a server, a poke of its tissue, and the address to open.

use std::io::{BufRead, BufReader};
use std::process::{ChildStdout, Stdio};

use crate::execute::{TaskFailure, command, run};
use crate::interrupt;
use crate::plan::Step;

/// Starts a server, plays a script on it by `poke`, prints where to look, and waits until the server ends.
///
/// # Errors
/// Returns an error if the server does not start, the poke fails, or the server ends otherwise than by Ctrl-C.
pub(crate) fn serve(server: &Step, poke: &Step) -> Result<(), TaskFailure> {
    let folder = |error| TaskFailure::Failed(format!("can't make the folder `target` for the records: {error}"));
    std::fs::create_dir_all("target").map_err(folder)?;
    let mut starting = command(server)?;
    starting.stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = interrupt::start(starting)
        .map_err(|error| TaskFailure::Failed(format!("`{server}` did not start: {error}")))?;
    let told = child.stdout.take().and_then(|output| {
        let mut output = BufReader::new(output);
        url(&mut output).map(|url| (url, output))
    });
    let Some((url, output)) = told else {
        let ended = interrupt::wait(&mut child);
        let reason = "No server, so nothing to see. Another port: cargo xtask run --listen 127.0.0.1:0";
        // Ctrl-C before it listens.
        return if ended { Ok(()) } else { Err(TaskFailure::Failed(reason.to_owned())) };
    };
    let mut poke = poke.clone();
    poke.arguments.extend(["--server".to_owned(), url.clone()]);
    if let Err(failure) = run(&poke) {
        interrupt::end(&mut child);
        return Err(failure);
    }
    println!("\nThe records are in target/poke.jsonl. Serving until Ctrl-C. To touch the tissue, open\n\n    {url}\n");
    drain(output);
    if interrupt::wait(&mut child) { Ok(()) } else { Err(TaskFailure::Failed(format!("`{server}` failed"))) }
}

/// Returns the address in the first line with one; `None` if the output ends before it.
fn url(output: &mut impl BufRead) -> Option<String> {
    let lines = output.lines().map_while(Result::ok);
    lines.into_iter().find_map(|line| {
        let url = &line[line.find("http")?..];
        url.split_whitespace().next().map(str::to_owned)
    })
}

/// Reads until the server closes its output, so that it never waits for a reader.
fn drain(output: BufReader<ChildStdout>) {
    output.lines().map_while(Result::ok).for_each(drop);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_is_that_of_the_first_line_with_one() {
        let text = "a line\npalpate listens on http://127.0.0.1:7117\nmetrics are at http://127.0.0.1:9000/metrics\n";
        assert_eq!(url(&mut text.as_bytes()).as_deref(), Some("http://127.0.0.1:7117"));
        assert_eq!(url(&mut "palpate listens on https://[::1]:1 now\n".as_bytes()).as_deref(), Some("https://[::1]:1"));
        assert_eq!(url(&mut "nothing\n".as_bytes()), None);
    }
}
