//! `palpate token`: creates a token for clients of a server.

use std::io::Write;
use std::path::PathBuf;

use palpate::server::identity::{self, Role};
use palpate_tissue::files;

use super::Failure;

#[derive(clap::Args)]
pub(crate) struct TokenArguments {
    /// Name of the token's owner, for the log
    #[arg(long)]
    name: String,
    /// Roles of the token: watch, touch, create, administer; separated by commas
    #[arg(long, value_name = "ROLE", required = true, value_delimiter = ',')]
    role: Vec<String>,
    /// Append the entry to this file instead of printing it
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,
}

/// Creates a token.
pub(crate) fn token(arguments: &TokenArguments) -> Result<(), Failure> {
    let roles: Vec<Role> = arguments.role.iter().map(|role| Role::named(role)).collect::<Result<_, _>>()?;
    let token = identity::new_token()?;
    let entry = identity::entry(&arguments.name, &roles, &token)?;
    let Some(path) = &arguments.tokens else {
        let printed = writeln!(
            std::io::stdout(),
            "# For the client (--token-file or PALPATE_TOKEN); it is not stored anywhere:\n{token}\n\n\
             # For the server's file (--tokens):\n{entry}"
        );
        return printed.map_err(|e| Failure::Failed(e.to_string()));
    };
    // A server must be able to read the file with the new entry; otherwise it is refused here, with the reason.
    if path.symlink_metadata().is_ok() {
        let text = files::read_regular_text(path, files::MAX_SECRET_BYTES)?;
        identity::KnownCallers::parse(path, &format!("{text}\n{entry}"))?;
    }
    let refuse = |e: std::io::Error| Failure::Refused(format!("{}: can't be written: {e}", path.display()));
    let mut file = files::private_options().append(true).create(true).open(path).map_err(refuse)?;
    // One write, because a server may read the file at any moment.
    file.write_all(format!("\n{entry}").as_bytes()).map_err(refuse)?;
    writeln!(std::io::stdout(), "{token}").map_err(|e| Failure::Failed(e.to_string()))
}
