//! `palpate journal key`: makes a key with which a server signs its journals.

use std::path::PathBuf;

use super::super::certificate::write_key;
use super::super::{Failure, say, write_file};

#[derive(clap::Args)]
pub(super) struct KeyArguments {
    /// The private key to write, for `palpate serve --journal-key`; FILE.pub gets the public one, for `verify --signed-by`
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

/// Makes both keys. Files that exist are not overwritten: journals that the old key signed could no longer be checked.
pub(super) fn key(KeyArguments { file }: &KeyArguments) -> Result<(), Failure> {
    let mut public = file.clone().into_os_string();
    public.push(".pub");
    let public = PathBuf::from(public);
    for path in [file, &public] {
        if path.exists() {
            return Err(Failure::Refused(format!("{}: exists already; give another name", path.display())));
        }
    }
    let made = rcgen::KeyPair::generate_for(&rcgen::PKCS_ED25519);
    let key = made.map_err(|e| Failure::Failed(format!("can't make a key: {e}")))?;
    write_key(file, &key.serialize_pem())?;
    write_file(&public, key.public_key_pem().as_bytes())?;
    let (file, public) = (file.display(), public.display());
    say!(
        "{file} is for `palpate serve --journal-key {file}`; {public} is for `palpate journal verify --signed-by {public}`"
    );
    Ok(())
}
