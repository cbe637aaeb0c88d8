//! `palpate journal verify`: simulates journals again, and compares every hash; checks signatures.

use std::path::{Path, PathBuf};

use palpate::server::journal_key;
use palpate_refusal::Refusal;
use palpate_session::journal::signature::{PublicKey, Signatures, Signed};
use palpate_session::journal::{JournalReader, Replay, Verdict};
use palpate_tissue::files;

use super::super::{Failure, clock_s, say, with_progress};
use super::limits;

#[derive(clap::Args)]
pub(super) struct VerifyArguments {
    /// The journals
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Check that the server with this public key (PEM) signed each journal, and that nothing was changed since
    #[arg(long, value_name = "KEY.pub")]
    signed_by: Option<PathBuf>,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Verifies each journal. The worst result determines the exit status.
pub(super) fn verify(arguments: &VerifyArguments) -> Result<(), Failure> {
    let limits = limits(arguments.config.as_deref())?;
    let key = arguments.signed_by.as_deref().map(public_key).transpose()?;
    let (mut differs, mut unread) = (Vec::new(), Vec::new());
    for path in &arguments.files {
        let (name, begun_s) = (path.display(), clock_s());
        let verdict = JournalReader::open(path).and_then(|reader| {
            let mut reader = reader.up_to_damage();
            let survey = reader.survey(&mut |_| {})?;
            let (last, damage) = (survey.until_step, survey.damage.clone());
            let signed = key.map(|key| signed(&mut reader, key)).transpose();
            let replay = Replay::new(reader, survey, &limits)?;
            let verdict = with_progress("step", last, false, |progress| replay.verify(&mut |step, _| progress(step)))?;
            Ok((verdict, damage, signed))
        });
        let (verdict, damage, signed) = match verdict {
            Err(refusal) => {
                unread.push(refusal.to_string());
                continue;
            }
            Ok(found) => found,
        };
        match &verdict.difference {
            Some(difference) => differs.push(format!("{name}: {difference}")),
            None => say!("{name}: {}, in {:.2} s", proved(&verdict), clock_s() - begun_s),
        }
        unread.extend(damage.map(|damage| format!("{name}: {damage}; the rest was not checked")));
        match signed {
            Ok(None) => {}
            Ok(Some(signed)) => match of_signature(signed) {
                Ok(text) => say!("{name}: {text}"),
                Err(text) => differs.push(format!("{name}: {text}")),
            },
            Err(refusal) => differs.push(refusal.to_string()),
        }
    }
    let failure = if unread.is_empty() { Failure::Failed } else { Failure::Refused };
    let mut problems = [unread, differs].concat();
    let last = problems.pop();
    for problem in problems {
        say!("palpate: {problem}");
    }
    last.map_or(Ok(()), |problem| Err(failure(problem)))
}

/// Reads the key in a file.
fn public_key(path: &Path) -> Result<PublicKey, Failure> {
    let refuse = |why: String| Failure::Refused(format!("--signed-by {}: {why}", path.display()));
    let text = files::read_text(path, files::MAX_SECRET_BYTES).map_err(|refusal| refuse(refusal.message))?;
    journal_key::public(&text).map_err(|refusal| refuse(refusal.message))
}

/// Checks the signatures of a journal, which is read from its beginning and stands there afterwards.
fn signed(reader: &mut JournalReader<'_>, key: PublicKey) -> Result<Option<Signed>, Refusal> {
    let mut signatures = Signatures::of(key);
    reader.rewind();
    let mut check = || {
        while let Some(batch) = reader.next_batch()? {
            signatures.check(&batch)?;
        }
        Ok(signatures.signed())
    };
    let checked = check();
    reader.rewind();
    checked
}

/// Returns how many steps of a journal were proved to give the same bits, as a text.
fn proved(verdict: &Verdict) -> String {
    let Verdict { steps: [from, to], proved_until, compared: [hashes, snapshots], .. } = verdict;
    let (steps, proved) = (to - from, proved_until - from);
    let count = |count: u64, one: &str, many: &str| format!("{count} {}", if count == 1 { one } else { many });
    let compared = format!("{}, {}", count(*hashes, "hash", "hashes"), count(*snapshots, "snapshot", "snapshots"));
    match proved {
        0 if steps == 0 => format!("has no steps ({compared})"),
        0 => format!("0 of {steps} steps proved: it has no hash after its beginning at step {from} ({compared})"),
        _ if proved == steps => format!("{steps} of {steps} steps proved, {from} to {to}: {compared}"),
        _ => format!(
            "{proved} of {steps} steps proved, {from} to {proved_until}: {compared}; the {} steps after the last hash can be \
             anything",
            steps - proved
        ),
    }
}

/// Returns what the signatures prove about a journal, or why they prove too little.
fn of_signature(signed: Option<Signed>) -> Result<String, String> {
    match signed {
        None => Err("has no signature: its server has no key (`palpate serve --journal-key`)".to_owned()),
        Some(Signed { until_step, unsigned: 0, ended: true }) => Ok(format!(
            "signed whole, up to its end at step {until_step}: nobody has changed it since its server wrote it"
        )),
        Some(Signed { until_step, unsigned: 0, .. }) => Ok(format!(
            "signed up to step {until_step}: nobody has changed that; it has no end, so a part may have been cut off behind it"
        )),
        Some(Signed { until_step, unsigned, .. }) => Err(format!(
            "is signed up to step {until_step} only: {unsigned} messages after that have no signature, and anybody may have \
             written them"
        )),
    }
}
