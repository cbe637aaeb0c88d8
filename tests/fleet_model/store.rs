//! etcd as it promises to be: one store with revisions, transactions, and keys under leases.

use std::collections::{BTreeMap, BTreeSet};

use palpate_cluster::etcd::{Compare, KeyValue, Op, TransactionOutcome, Txn};

use crate::Ns;

/// A change of a key, as a watch reports it.
#[derive(Debug, Clone)]
pub(crate) struct Change {
    pub(crate) key: String,
    /// `None`: it is gone.
    pub(crate) value: Option<Vec<u8>>,
    pub(crate) revision: u64,
}

struct Lease {
    /// It ends no earlier.
    until: Ns,
    keys: BTreeSet<String>,
}

#[derive(Default)]
pub(crate) struct Store {
    keys: BTreeMap<String, KeyValue>,
    pub(crate) revision: u64,
    leases: BTreeMap<i64, Lease>,
    newest_lease: i64,
    /// All changes, oldest first.
    pub(crate) history: Vec<Change>,
}

impl Store {
    pub(crate) fn get(&self, key: &str) -> Option<KeyValue> {
        self.keys.get(key).cloned()
    }

    pub(crate) fn list(&self, prefix: &str) -> Vec<KeyValue> {
        let from = self.keys.range(prefix.to_owned()..);
        from.take_while(|(key, _)| key.starts_with(prefix)).map(|(_, found)| found.clone()).collect()
    }

    fn holds(&self, compare: &Compare) -> bool {
        match compare {
            Compare::Absent(key) => !self.keys.contains_key(key),
            Compare::Present(key) => self.keys.contains_key(key),
            Compare::ModRevision(key, at) => self.keys.get(key).map_or(0, |found| found.mod_revision) == *at,
        }
    }

    /// `None`: refused, because a lease is not there.
    pub(crate) fn transact(&mut self, txn: &Txn) -> Option<TransactionOutcome> {
        let succeeded = txn.if_all.iter().all(|compare| self.holds(compare));
        let ops = if succeeded { &txn.then } else { &txn.otherwise };
        let has_lease = |op: &Op| !matches!(op, Op::Put { lease: Some(id), .. } if !self.leases.contains_key(id));
        if !ops.iter().all(has_lease) {
            return None;
        }
        let writes = ops.iter().any(|op| match op {
            Op::Put { .. } => true,
            Op::Delete(key) => self.keys.contains_key(key),
            Op::Get(_) => false,
        });
        self.revision += u64::from(writes);
        let mut got = Vec::new();
        for op in ops {
            match op {
                Op::Put { key, value, lease } => self.put(key, value, lease.unwrap_or_default()),
                Op::Delete(key) => self.delete(key),
                Op::Get(key) => got.push(self.get(key)),
            }
        }
        Some(TransactionOutcome { succeeded, revision: self.revision, got })
    }

    fn put(&mut self, key: &str, value: &[u8], lease: i64) {
        let before = self.keys.get(key);
        let create_revision = before.map_or(self.revision, |found| found.create_revision);
        if let Some(old) = before.and_then(|found| self.leases.get_mut(&found.lease)) {
            old.keys.remove(key);
        }
        if let Some(new) = self.leases.get_mut(&lease) {
            new.keys.insert(key.to_owned());
        }
        let mod_revision = self.revision;
        let found = KeyValue { key: key.to_owned(), value: value.to_vec(), create_revision, mod_revision, lease };
        self.keys.insert(key.to_owned(), found);
        self.history.push(Change { key: key.to_owned(), value: Some(value.to_vec()), revision: mod_revision });
    }

    fn delete(&mut self, key: &str) {
        if let Some(gone) = self.keys.remove(key) {
            if let Some(lease) = self.leases.get_mut(&gone.lease) {
                lease.keys.remove(key);
            }
            self.history.push(Change { key: key.to_owned(), value: None, revision: self.revision });
        }
    }

    pub(crate) fn grant(&mut self, until: Ns) -> i64 {
        self.newest_lease += 1;
        self.leases.insert(self.newest_lease, Lease { until, keys: BTreeSet::new() });
        self.newest_lease
    }

    /// Whether it is there.
    pub(crate) fn keep_alive(&mut self, lease: i64, until: Ns) -> bool {
        self.leases.get_mut(&lease).map(|lease| lease.until = until).is_some()
    }

    pub(crate) fn until(&self, lease: i64) -> Option<Ns> {
        self.leases.get(&lease).map(|lease| lease.until)
    }

    /// A new leader gives leases their time anew.
    pub(crate) fn extend_all(&mut self, until: Ns) {
        self.leases.values_mut().for_each(|lease| lease.until = lease.until.max(until));
    }

    pub(crate) fn end(&mut self, lease: i64) {
        let Some(lease) = self.leases.remove(&lease) else { return };
        if !lease.keys.is_empty() {
            self.revision += 1;
        }
        lease.keys.iter().for_each(|key| self.delete(key));
    }
}
