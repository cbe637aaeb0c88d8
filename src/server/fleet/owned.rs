//! The sessions that this server owns in etcd: their keys are created, confirmed and deleted here, and unclear
//! transactions resolved.

use std::result::Result as Made;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep};
use tracing::warn;

use super::{Fleet, Owned, of_etcd};
use palpate_cluster::etcd::{Compare, EtcdError, TransactionOutcome, Txn};
use palpate_cluster::key::{SessionValue, decode};
use palpate_cluster::rules;
use palpate_realtime::SessionReservation;
use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_id;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// Time after which a session that was announced and has not arrived counts as given up, ns.
const COMES_NS: u64 = 300_000_000_000;

/// Longest time for which a deletion waits for etcd.
const DELETE_TIMEOUT: Duration = Duration::from_secs(5);

/// Pause before etcd is asked again.
const PAUSE: Duration = Duration::from_millis(100);

/// The value of a session's key and its revision; `None` if there is no such key.
pub(super) type Found = Option<(SessionValue, u64)>;

/// Marks a session as arriving at this server, until it is dropped: no other task here claims it, receives it or
/// reconciles it.
pub(super) struct Coming {
    fleet: Arc<Fleet>,
    id: String,
}

impl Drop for Coming {
    fn drop(&mut self) {
        lock(&self.fleet.coming).remove(&self.id);
    }
}

/// Returns the revision that a transaction requires at `key`; 0 if it requires none.
fn found_at(txn: &Txn, key: &str) -> u64 {
    let at = |compare: &Compare| match compare {
        Compare::ModRevision(of, revision) if of == key => Some(*revision),
        _ => None,
    };
    txn.if_all.iter().find_map(at).unwrap_or_default()
}

impl Fleet {
    /// Runs a transaction whose result may be unknown: then reads the session's key, from which `is_done` decides
    /// whether it took place. Returns the new revision, or what the key contains instead.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached, and if the result can't be determined yet: the request may still take place.
    pub(super) async fn transact(
        &self,
        txn: Txn,
        id: &str,
        is_done: impl Fn(Option<&SessionValue>) -> bool,
    ) -> Result<Made<u64, Found>> {
        let key = self.keys.session(id);
        let before = found_at(&txn, &key);
        let outcome = self.etcd.transact(txn).await;
        let unknown = match outcome {
            Ok(TransactionOutcome { succeeded: true, revision, .. }) => return Ok(Ok(revision)),
            Ok(_) => None,
            Err(error @ EtcdError::Unknown(_)) => Some(error),
            Err(error) => return Err(of_etcd(error)),
        };
        if unknown.is_some() {
            self.unsettled.notify_one();
        }
        let (found, _) = self.etcd.get(&key).await.map_err(of_etcd)?;
        let found = found.and_then(|found| Some((decode::<SessionValue>(&found.value)?, found.mod_revision)));
        let Some(unknown) = unknown else { return Ok(Err(found)) };
        // An unchanged key proves nothing, even if it has the requested value: it may have had it before.
        let now = found.as_ref().map_or(0, |found| found.1);
        if now == before {
            return Err(of_etcd(unknown));
        }
        Ok(if is_done(found.as_ref().map(|found| &found.0)) { Ok(now) } else { Err(found) })
    }

    /// Changes the key of a session of this server: `make` returns the transaction for the key's current revision. If
    /// this server itself has changed the key in the meantime, tries again with the new revision. Returns the new
    /// revision, or what the key contains if it belongs to another server.
    ///
    /// # Errors
    /// Returns the errors of [`Fleet::transact`].
    pub(super) async fn change(
        &self,
        id: &str,
        mut revision: u64,
        make: impl Fn(u64) -> Txn,
        is_done: impl Fn(Option<&SessionValue>) -> bool,
    ) -> Result<Made<u64, Found>> {
        loop {
            match self.transact(make(revision), id, &is_done).await? {
                Err(Some((value, now))) if value.node == self.node && now > revision => revision = now,
                ended => return Ok(ended),
            }
        }
    }

    /// Returns whether a key names this server as the owner and `standby` as its standby.
    pub(super) fn is_own(&self, found: Option<&SessionValue>, standby: &str) -> bool {
        found.is_some_and(|value| value.node == self.node && value.standby == standby)
    }

    /// Records that the session's key was written at that revision. Returns whether it is the newest that this server
    /// knows: an answer may arrive late.
    pub(super) fn owns_since(&self, id: &str, revision: u64) -> bool {
        let mut all = lock(&self.owned);
        let Some(owned) = all.get_mut(id).filter(|owned| owned.revision <= revision) else { return false };
        owned.revision = revision;
        true
    }

    /// Marks a session as arriving at this server. `None` if it is arriving already, or is here.
    pub(super) fn comes(self: &Arc<Self>, id: &str) -> Option<Coming> {
        let is_new = lock(&self.coming).insert(id.to_owned());
        let coming = is_new.then(|| Coming { fleet: self.clone(), id: id.to_owned() })?;
        (self.revision(id).is_none() && !self.pacer.has(id)).then_some(coming)
    }

    /// Creates the etcd key of a new session, with this server as its owner.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached, and if this server has lost its lease.
    pub(in crate::server) async fn birth(&self) -> Result<SessionReservation> {
        let id = random_id()?;
        let made = self.transact(rules::create(&self.keys, &id, &self.node), &id, |found| found.is_some()).await?;
        let revision = made.map_err(|_| palpate_realtime::fenced())?;
        lock(&self.owned).insert(id.clone(), Owned::since(revision));
        Ok(SessionReservation { id, revision, recorded: true })
    }

    /// Records that the session of a reservation was created, or, if `is_there` is false, removes its key.
    pub(in crate::server) async fn born(&self, birth: &SessionReservation, is_there: bool) {
        if let Some(owned) = lock(&self.owned).get_mut(&birth.id) {
            owned.was_here = true;
        }
        if !is_there {
            self.forget_the_deleted().await;
        }
    }

    /// Deletes the etcd keys of sessions that were deleted on this server, or never arrived.
    pub(super) async fn forget_the_deleted(&self) {
        let mut gone = Vec::new();
        for (id, owned) in lock(&self.owned).iter_mut() {
            let is_here = self.pacer.has(id);
            if !is_here && (owned.was_here || now_ns().saturating_sub(owned.since_ns) > COMES_NS) {
                gone.push((id.clone(), owned.revision));
            }
            owned.was_here |= is_here;
        }
        for (id, revision) in gone {
            if let Err(refusal) = self.forget(&id, revision).await {
                warn!(session = %id, "not deleted in etcd yet: {refusal}");
            }
        }
    }

    /// Deletes the key of a session of this server. Returns the value of the key if another server has the session.
    async fn forget(&self, id: &str, revision: u64) -> Result<Option<SessionValue>> {
        let delete = |revision| rules::delete(&self.keys, id, revision);
        let found = match self.change(id, revision, delete, |found| found.is_none()).await? {
            Ok(_) | Err(None) => None,
            Err(Some((value, _))) => Some(value),
        };
        lock(&self.owned).remove(id);
        let standby = lock(&self.standbys).remove(id).unwrap_or_default();
        self.growth.ended(id);
        if found.is_none() {
            self.tell_past(id, standby);
        }
        Ok(found)
    }

    /// Waits until a session that was deleted here is deleted in etcd too.
    ///
    /// # Errors
    /// Refuses if etcd does not confirm that in time: then the deletion continues later. Refuses if another server
    /// has the session in the meantime.
    pub(in crate::server) async fn until_deleted(&self, id: &str) -> Result<()> {
        let until = Instant::now() + DELETE_TIMEOUT;
        loop {
            let Some(revision) = self.revision(id) else {
                // Another task of this server has deleted it.
                return match self.session_value(id).await {
                    Ok(None) => Ok(()),
                    Ok(Some((value, _))) => Err(not_deleted(&format!("the server `{}` has the session", value.node))),
                    Err(refusal) => Err(not_deleted(&refusal.message)),
                };
            };
            let why = match tokio::time::timeout_at(until, self.forget(id, revision)).await {
                Ok(Ok(None)) => return Ok(()),
                Ok(Ok(Some(value))) => return Err(not_deleted(&format!("the server `{}` has it now", value.node))),
                Ok(Err(refusal)) => refusal.message,
                Err(_) => "etcd does not answer".to_owned(),
            };
            if Instant::now() + PAUSE >= until {
                return Err(not_deleted(&why));
            }
            sleep(PAUSE).await;
        }
    }

    /// Returns the revision at which this server owns a session; `None` if it does not.
    pub(super) fn revision(&self, id: &str) -> Option<u64> {
        lock(&self.owned).get(id).map(|owned| owned.revision)
    }

    /// Reads the session's key in etcd.
    pub(super) async fn session_value(&self, id: &str) -> Result<Found> {
        // A text that is not an ID would be another key.
        if id.len() != 32 || !id.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Ok(None);
        }
        let (found, _) = self.etcd.get(&self.keys.session(id)).await.map_err(of_etcd)?;
        Ok(found.and_then(|found| Some((decode(&found.value)?, found.mod_revision))))
    }
}

/// Returns the refusal of a deletion that etcd has not confirmed.
fn not_deleted(why: &str) -> Refusal {
    let message =
        format!("the session is deleted on this server, but whether the fleet has it no more is not sure yet: {why}");
    Refusal::new(Reason::Fenced, "session_id", message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_cluster::key::Keys;

    #[test]
    fn a_transaction_tells_the_revision_that_it_builds_on() {
        let keys = Keys::of("f").unwrap();
        let key = keys.session("s");
        assert_eq!(found_at(&rules::create(&keys, "s", "a"), &key), 0);
        assert_eq!(found_at(&rules::keep(&keys, "s", 7, "a", "b"), &key), 7);
        assert_eq!(found_at(&rules::delete(&keys, "s", 9), &key), 9);
        assert_eq!(found_at(&rules::hand_over(&keys, "s", 8, ["a", "b"]), &key), 8);
    }
}
