//! Command lines of both programs. Negative numbers are accepted as values, and an invalid number is refused in our
//! words.

use std::error::Error as _;
use std::ffi::OsString;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};

use clap::error::{ContextKind, ContextValue, Error, ErrorKind};
use clap::{Command, Parser};

use palpate_refusal::excerpt;
use palpate_refusal::printable::printable;

/// Parses the command line of this process. Returns only if the arguments are accepted. If they ask for help or the
/// version, prints it to stdout and ends the process with exit code 0; if they are refused, prints the reason to
/// stderr and ends it with exit code 2.
///
/// An option or argument with a value also accepts a negative number, such as `-1` or `-1e-3`.
pub fn parse<A: Parser>() -> A {
    match read(std::env::args_os()) {
        Ok(arguments) => arguments,
        Err(error) => match number(&error) {
            Some(message) => {
                let program = A::command().get_name().to_owned();
                let text = printable(format_args!("{program}: {message}"));
                let _ = std::io::Write::write_all(&mut std::io::stderr(), (text + "\n").as_bytes());
                std::process::exit(2)
            }
            None => error.exit(),
        },
    }
}

/// Parses `arguments`, the first of which is the name of the program, as [`parse`] parses those of this process.
///
/// # Errors
/// Returns the reason of a refusal, in one line.
pub fn parse_from<A: Parser>(arguments: impl IntoIterator<Item = OsString>) -> Result<A, String> {
    read(arguments).map_err(|error| {
        number(&error).unwrap_or_else(|| {
            let text = error.to_string();
            let line = text.lines().next().unwrap_or_default();
            line.strip_prefix("error: ").unwrap_or(line).to_owned()
        })
    })
}

fn read<A: Parser>(arguments: impl IntoIterator<Item = OsString>) -> Result<A, Error> {
    let mut command = with_negative_numbers(A::command());
    let matches = command.try_get_matches_from_mut(arguments.into_iter().map(without_exponent))?;
    A::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Rewrites `-1e-3` as `-0.001`: clap would take the former for an option.
fn without_exponent(argument: OsString) -> OsString {
    let number = argument.to_str().filter(|text| text.starts_with('-') && text.contains("e-"));
    number.and_then(|text| text.parse::<f64>().ok()).map_or(argument, |number| number.to_string().into())
}

/// Makes each option and argument accept a value such as `-1`. An invalid value is then refused for its own reason,
/// and not as an unknown option.
fn with_negative_numbers(command: Command) -> Command {
    let command = command.mut_args(|argument| {
        let takes_values = argument.get_action().takes_values();
        if takes_values { argument.allow_negative_numbers(true) } else { argument }
    });
    command.mut_subcommands(with_negative_numbers)
}

/// Returns the message for an option's value that is not a valid number; `None` for any other error.
fn number(error: &Error) -> Option<String> {
    if error.kind() != ErrorKind::ValueValidation {
        return None;
    }
    let text = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let (option, value) = (text(ContextKind::InvalidArg)?, text(ContextKind::InvalidValue)?);
    let source = error.source()?;
    let wants = if let Some(problem) = source.downcast_ref::<ParseIntError>() {
        match problem.kind() {
            IntErrorKind::PosOverflow => "a smaller whole number",
            _ => "a whole number from 0",
        }
    } else if source.is::<ParseFloatError>() {
        "a number"
    } else {
        return None;
    };
    // `--threads <N>` is shown as `--threads`.
    let option = option.split_once(" <").map_or(option, |(option, _)| option);
    Some(format!("{option}: must be {wants}, but is `{}`", excerpt(value)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Parser, Debug)]
    struct TestArguments {
        #[arg(long)]
        unit: Option<String>,
        #[arg(long)]
        threads: Option<usize>,
        #[arg(long)]
        edge_mm: Option<f64>,
        #[arg(long)]
        json: bool,
        name: Option<String>,
    }

    fn read_of(arguments: &[&str]) -> Result<TestArguments, Error> {
        read(std::iter::once("program").chain(arguments.iter().copied()).map(OsString::from))
    }

    #[test]
    fn a_negative_number_is_a_value_and_another_option_is_none() {
        assert_eq!(read_of(&["--unit", "-1"]).unwrap().unit.as_deref(), Some("-1"));
        assert_eq!(read_of(&["--edge-mm", "-2.5e-1", "--json"]).unwrap().edge_mm, Some(-0.25));
        assert_eq!(read_of(&["-3"]).unwrap().name.as_deref(), Some("-3"));
        assert!(read_of(&["--unit", "--json"]).is_err());
    }

    #[test]
    fn a_refusal_is_one_line() {
        let refused = |arguments: [&str; 2]| {
            parse_from::<TestArguments>(["program"].into_iter().chain(arguments).map(OsString::from)).unwrap_err()
        };
        assert_eq!(refused(["--untit", "m"]), "unexpected argument '--untit' found");
        assert_eq!(refused(["--threads", "two"]), "--threads: must be a whole number from 0, but is `two`");
    }

    #[test]
    fn a_number_that_is_none_is_refused_with_what_would_be_one() {
        for (arguments, told) in [
            (["--threads", "-1"], Some("--threads: must be a whole number from 0, but is `-1`")),
            (["--threads", "two"], Some("--threads: must be a whole number from 0, but is `two`")),
            (["--threads", "1.5"], Some("--threads: must be a whole number from 0, but is `1.5`")),
            (
                ["--threads", "99999999999999999999"],
                Some("--threads: must be a smaller whole number, but is `99999999999999999999`"),
            ),
            (["--edge-mm", "wide"], Some("--edge-mm: must be a number, but is `wide`")),
            (["--edges", "3"], None),
        ] {
            assert_eq!(number(&read_of(&arguments).unwrap_err()).as_deref(), told, "{arguments:?}");
        }
    }
}
