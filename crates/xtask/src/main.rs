//! The program behind `cargo xtask`: builds, tests and shows Palpate from its sources, without make or a shell.
//!
//! `arguments` reads the command line, `system` finds out what this machine has, `plan` lists the commands of a task, and
//! `execute` runs them. A task can therefore be tested without running it.

mod arguments;
mod execute;
mod interrupt;
mod plan;
mod serving;
mod system;

use std::process::ExitCode;

use arguments::CommandLine;
use system::System;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args_os().skip(1).map(|one| one.to_string_lossy().into_owned()).collect();
    let request = match arguments::read(&arguments) {
        Ok(CommandLine::Help(text)) => {
            println!("{text}");
            return ExitCode::SUCCESS;
        }
        Ok(CommandLine::ProjectTask { task, only_plan }) => (task, only_plan),
        Err(message) => {
            eprintln!("xtask: {message}");
            return ExitCode::from(2);
        }
    };
    let (task, only_plan) = request;
    let ended = System::find().and_then(|system| {
        let stages = plan::plan(&task, &system)?;
        if only_plan {
            print!("{}", plan::shown(&stages));
            return Ok(());
        }
        execute::execute(&stages)
    });
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("xtask: {failure}");
            ExitCode::from(failure.status())
        }
    }
}
