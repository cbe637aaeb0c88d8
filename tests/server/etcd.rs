//! The client of etcd against real members: each call, and what comes of calls when members die, freeze or ask who we
//! are.
#![cfg(unix)]

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::common::etcd::{Certificates, EtcdMembers, SHORT_TIMES};
use crate::common::server::until;
use palpate_cluster::etcd::{
    Compare, Etcd as Client, EtcdError, EtcdOptions, Op, TransactionOutcome, Txn, Watch, WatchError, WatchEvent,
};
use rcgen::{BasicConstraints, CertificateParams, DistinguishedName, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};

/// Long enough for any machine.
const ETCD_TIMEOUT: Duration = Duration::from_secs(60);

/// Timeout of an attempt while members die: longer than on a busy machine, shorter than that of a test.
const LIMIT: Duration = Duration::from_secs(1);

fn started(members: usize) -> EtcdMembers {
    EtcdMembers::start_with(members, SHORT_TIMES, &[], |_| None)
}

fn options(etcd: &EtcdMembers) -> EtcdOptions {
    EtcdOptions { endpoints: etcd.endpoints(), ..Default::default() }
}

fn client(etcd: &EtcdMembers) -> Client {
    Client::open_within(&options(etcd), LIMIT).unwrap()
}

fn put(key: &str, value: &str, lease: Option<i64>) -> Op {
    Op::Put { key: key.to_owned(), value: value.as_bytes().to_vec(), lease }
}

fn of(then: Vec<Op>) -> Txn {
    Txn { then, ..Default::default() }
}

/// Repeats what can't be done for the moment.
async fn at_last<T, A: Future<Output = Result<T, EtcdError>>>(call: impl Fn() -> A) -> T {
    let begun = Instant::now();
    loop {
        match call().await {
            Ok(done) => return done,
            Err(EtcdError::Refused(why)) => panic!("{why}"),
            Err(error) => assert!(begun.elapsed() < ETCD_TIMEOUT, "{error}"),
        }
    }
}

/// Writes a key that is not there, once, whatever becomes of the answers; the revision.
async fn make(client: &Client, key: &str) -> u64 {
    let compare = vec![Compare::Absent(key.to_owned())];
    let txn = Txn { if_all: compare, then: vec![put(key, "made", None)], otherwise: vec![Op::Get(key.to_owned())] };
    let outcome = at_last(|| client.transact(txn.clone())).await;
    match outcome.got.first() {
        Some(made) => made.as_ref().unwrap().mod_revision,
        None => outcome.revision,
    }
}

async fn next(watch: &mut Watch) -> Result<Vec<WatchEvent>, WatchError> {
    tokio::time::timeout(ETCD_TIMEOUT, watch.next()).await.expect("the watch says nothing")
}

#[tokio::test]
async fn each_call() {
    if !EtcdMembers::is_there() {
        return;
    }
    let mut etcd = started(1);
    let client = client(&etcd);
    assert_eq!(client.get("a").await.unwrap().0, None);

    let made = client.transact(of(vec![put("a", "1", None)])).await.unwrap();
    let (read, revision) = client.get("a").await.unwrap();
    let read = read.unwrap();
    assert_eq!((read.key.as_str(), read.value.as_slice(), read.lease), ("a", b"1".as_slice(), 0));
    assert_eq!((read.create_revision, read.mod_revision, revision), (made.revision, made.revision, made.revision));

    compares(&client, made.revision).await;
    lists(&client).await;
    leases(&client).await;

    // A refusal of etcd is not tried again, and its result is known.
    let twice = client.transact(of(vec![put("b", "1", None), put("b", "2", None)])).await;
    assert!(matches!(&twice, Err(EtcdError::Refused(why)) if why.contains("duplicate key")), "{twice:?}");
    assert_eq!(client.get("b").await.unwrap().0, None);

    // A member that is gone has done nothing; one that is back is found again.
    etcd.kill(0);
    assert!(matches!(client.get("c").await, Err(EtcdError::Unreachable(_))));
    let gone = client.transact(of(vec![put("c", "1", None)])).await;
    let Err(EtcdError::Unreachable(why)) = gone else { panic!("{gone:?}") };
    assert!(why.contains(&etcd.endpoints()[0]), "{why}");
    etcd.restart_all();
    assert_eq!(client.get("c").await.unwrap().0, None);

    // One that accepts a transaction and says nothing may do it later, or not. It gets no other before it answers
    // again.
    etcd.pause(0);
    let frozen = client.transact(of(vec![put("c", "1", None)])).await;
    assert!(matches!(&frozen, Err(EtcdError::Unknown(why)) if why.contains("read")), "{frozen:?}");
    let again = client.transact(of(vec![put("d", "1", None)])).await;
    assert!(matches!(again, Err(EtcdError::Unreachable(_))), "{again:?}");
    etcd.resume(0);
    make(&client, "c").await;
    assert_eq!(client.get("d").await.unwrap().0, None);
}

async fn compares(client: &Client, revision: u64) {
    let does = |compare: Compare| async {
        let txn =
            Txn { if_all: vec![compare], then: vec![], otherwise: vec![Op::Get("a".into()), Op::Get("no".into())] };
        client.transact(txn).await.unwrap()
    };
    for (compare, holds) in [
        (Compare::Absent("a".into()), false),
        (Compare::Absent("no".into()), true),
        (Compare::Present("a".into()), true),
        (Compare::Present("no".into()), false),
        (Compare::ModRevision("a".into(), revision), true),
        (Compare::ModRevision("a".into(), revision + 1), false),
    ] {
        let TransactionOutcome { succeeded, got, .. } = does(compare.clone()).await;
        assert_eq!(succeeded, holds, "{compare:?}");
        let got: Vec<_> = got.iter().map(|one| one.as_ref().map(|kv| kv.mod_revision)).collect();
        assert_eq!(got, if holds { vec![] } else { vec![Some(revision), None] });
    }
    let deleted = client.transact(of(vec![Op::Delete("a".into()), Op::Delete("no".into())])).await.unwrap();
    assert_eq!(deleted.revision, revision + 1);
    assert_eq!(client.get("a").await.unwrap(), (None, revision + 1));
}

async fn lists(client: &Client) {
    let name = |index: usize| format!("list/{index:05}");
    for part in (0..2500).collect::<Vec<_>>().chunks(100) {
        client.transact(of(part.iter().map(|&index| put(&name(index), "", None)).collect())).await.unwrap();
    }
    let outside = of(["lisa", "list.", "list0", "m"].map(|key| put(key, "", None)).into());
    let revision = client.transact(outside).await.unwrap().revision;
    let (listed, at) = client.list("list/").await.unwrap();
    assert_eq!(at, revision);
    assert!(listed.iter().map(|kv| kv.key.clone()).eq((0..2500).map(name)));
    assert_eq!(client.list("nothing/").await.unwrap(), (vec![], revision));
    assert_eq!(client.list("").await.unwrap().0.len(), 2504);
}

async fn leases(client: &Client) {
    let lease = client.grant(60).await.unwrap();
    assert!(lease.ttl_s >= 60);
    client.transact(of(vec![put("leased", "", Some(lease.id))])).await.unwrap();
    assert_eq!(client.get("leased").await.unwrap().0.unwrap().lease, lease.id);
    for _ in 0..3 {
        assert_eq!(client.keep_alive(lease.id).await.unwrap(), Some(lease.ttl_s));
    }
    assert_eq!(client.keep_alive(lease.id ^ 1).await.unwrap(), None);
    // Two at a time do not get each other's answers.
    let other = client.grant(90).await.unwrap();
    let both = tokio::join!(client.keep_alive(lease.id), client.keep_alive(other.id));
    assert_eq!((both.0.unwrap(), both.1.unwrap()), (Some(lease.ttl_s), Some(other.ttl_s)));
    client.revoke(lease.id).await.unwrap();
    client.revoke(lease.id).await.unwrap();
    assert_eq!(client.keep_alive(lease.id).await.unwrap(), None);
    assert_eq!(client.get("leased").await.unwrap().0, None);
    let ended = client.transact(of(vec![put("leased", "", Some(lease.id))])).await;
    assert!(matches!(&ended, Err(EtcdError::Refused(why)) if why.contains("lease not found")), "{ended:?}");
    let long = client.grant(u64::MAX).await;
    assert!(matches!(long, Err(EtcdError::Refused(_))), "{long:?}");
}

#[tokio::test]
async fn a_lease_that_is_not_kept_alive_ends_with_its_keys() {
    if !EtcdMembers::is_there() {
        return;
    }
    let etcd = started(1);
    let client = client(&etcd);
    let lease = client.grant(1).await.unwrap();
    let made = client.transact(of(vec![put("gone/1", "", Some(lease.id)), put("stays", "", None)])).await.unwrap();
    let mut watch = client.watch("gone/", made.revision);
    let batch = next(&mut watch).await.unwrap();
    assert!(matches!(&batch[..], [WatchEvent::Put(kv)] if kv.lease == lease.id), "{batch:?}");
    let batch = next(&mut watch).await.unwrap();
    let [WatchEvent::Delete { key, revision }] = &batch[..] else { panic!("{batch:?}") };
    assert_eq!((key.as_str(), *revision > made.revision), ("gone/1", true));
    assert_eq!(client.keep_alive(lease.id).await.unwrap(), None);
    assert!(client.get("stays").await.unwrap().0.is_some());
}

#[tokio::test]
async fn a_watch_begins_where_it_is_told_to_and_says_what_is_lost() {
    if !EtcdMembers::is_there() {
        return;
    }
    let etcd = started(1);
    let client = client(&etcd);
    let first = make(&client, "w/1").await;
    let second = make(&client, "w/2").await;

    // Of a transaction, all changes come together, in order; of other keys none.
    let mut watch = client.watch("w/", second);
    assert_eq!(next(&mut watch).await.unwrap().len(), 1);
    let both = of(vec![put("w/3", "", None), Op::Delete("w/1".into()), put("x", "", None)]);
    let revision = client.transact(both).await.unwrap().revision;
    let batch = next(&mut watch).await.unwrap();
    let [WatchEvent::Put(put), WatchEvent::Delete { key, revision: deleted }] = &batch[..] else { panic!("{batch:?}") };
    assert_eq!((put.key.as_str(), put.mod_revision, key.as_str(), *deleted), ("w/3", revision, "w/1", revision));

    // A caller that stops waiting loses nothing, and a watch outlives its own silence.
    let silence = 3 * LIMIT;
    assert!(tokio::time::timeout(silence, watch.next()).await.is_err());
    let fourth = make(&client, "w/4").await;
    let batch = next(&mut watch).await.unwrap();
    assert!(matches!(&batch[..], [WatchEvent::Put(kv)] if kv.mod_revision == fourth), "{batch:?}");

    // From now on: nothing that was before.
    let mut from_now = client.watch("w/", 0);
    assert!(tokio::time::timeout(LIMIT, from_now.next()).await.is_err());
    let fifth = make(&client, "w/5").await;
    let batch = next(&mut from_now).await.unwrap();
    assert!(matches!(&batch[..], [WatchEvent::Put(kv)] if kv.mod_revision == fifth), "{batch:?}");

    etcd.control(&["compaction", &fifth.to_string()]);
    let mut late = client.watch("w/", first);
    for _ in 0..2 {
        assert_eq!(next(&mut late).await, Err(WatchError::Compacted { since: first }));
    }
    // The list continues from where the history begins.
    let (listed, at) = client.list("w/").await.unwrap();
    assert_eq!(listed.len(), 4);
    let mut anew = client.watch("w/", at + 1);
    let sixth = make(&client, "w/6").await;
    let batch = next(&mut anew).await.unwrap();
    assert!(matches!(&batch[..], [WatchEvent::Put(kv)] if kv.mod_revision == sixth), "{batch:?}");
}

#[tokio::test]
async fn a_watch_outlives_the_death_and_the_frost_of_its_member() {
    if !EtcdMembers::is_there() {
        return;
    }
    const KEYS: usize = 60;
    let mut etcd = started(3);
    let client = client(&etcd);
    let mut watch = client.watch("n/", make(&client, "begin").await);
    let writer = tokio::spawn({
        let client = client.clone();
        async move {
            let mut revisions = Vec::new();
            for index in 0..KEYS {
                revisions.push((format!("n/{index}"), make(&client, &format!("n/{index}")).await));
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            revisions
        }
    });
    let (mut seen, mut killed) = (Vec::new(), None);
    while seen.len() < KEYS {
        let before = seen.len();
        for event in next(&mut watch).await.unwrap() {
            let WatchEvent::Put(kv) = event else { panic!("{event:?}") };
            seen.push((kv.key, kv.mod_revision));
        }
        let passed = |mark: usize| before < mark && seen.len() >= mark;
        let at = etcd.index(watch.endpoint().unwrap());
        if passed(KEYS / 4) {
            etcd.kill(at);
            killed = Some(at);
        } else if let Some(killed) = killed.take_if(|_| passed(KEYS / 2)) {
            etcd.restart(killed);
            etcd.wait();
            etcd.pause(at);
        }
    }
    assert_eq!(seen, writer.await.unwrap());
}

#[tokio::test]
async fn calls_go_on_when_the_leader_dies_or_freezes() {
    if !EtcdMembers::is_there() {
        return;
    }
    let mut etcd = started(3);
    let client = client(&etcd);
    let lease = client.grant(60).await.unwrap();
    for round in 0..4 {
        let leader = etcd.leader().unwrap();
        if round % 2 == 0 {
            etcd.kill(leader);
        } else {
            etcd.pause(leader);
        }
        let key = format!("round/{round}");
        make(&client, &key).await;
        assert!(at_last(|| client.get(&key)).await.0.is_some());
        assert_eq!(at_last(|| client.list("round/")).await.0.len(), round + 1);
        assert_eq!(at_last(|| client.keep_alive(lease.id)).await, Some(lease.ttl_s));
        if round % 2 == 0 {
            etcd.restart(leader);
        } else {
            etcd.resume(leader);
        }
        etcd.wait();
    }
    // Two of three are no majority.
    etcd.kill(0);
    etcd.kill(1);
    let alone = client.get("round/0").await;
    assert!(matches!(alone, Err(EtcdError::Unreachable(_))), "{alone:?}");
    etcd.restart_all();
    assert!(at_last(|| client.get("round/0")).await.0.is_some());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_thousand_transactions_at_once_are_done_once_each_though_members_die() {
    if !EtcdMembers::is_there() {
        return;
    }
    const TASKS: usize = 1000;
    const COUNTERS: usize = 100;
    let mut etcd = started(3);
    let client = client(&etcd);
    let (done, unknown) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let mut tasks = tokio::task::JoinSet::new();
    for task in 0..TASKS {
        let (client, done, unknown) = (client.clone(), done.clone(), unknown.clone());
        tasks.spawn(async move {
            increment(&client, &format!("counter/{}", task % COUNTERS), &format!("done/{task}"), &unknown).await;
            done.fetch_add(1, Ordering::Relaxed);
        });
    }
    for part in 1..=2 {
        until(&format!("{part} thirds of {TASKS} tasks"), async || done.load(Ordering::Relaxed) >= part * TASKS / 3)
            .await;
        let at = etcd.index(client.endpoint());
        etcd.kill(at);
        tokio::time::sleep(Duration::from_millis(200)).await;
        etcd.restart(at);
        tokio::task::block_in_place(|| etcd.wait());
    }
    let begun = Instant::now();
    while let Some(ended) = tasks.join_next().await {
        ended.unwrap();
        assert!(begun.elapsed() < 2 * ETCD_TIMEOUT);
    }
    let counters = at_last(|| client.list("counter/")).await.0;
    let sum: usize = counters.iter().map(|kv| String::from_utf8_lossy(&kv.value).parse::<usize>().unwrap()).sum();
    assert_eq!((sum, at_last(|| client.list("done/")).await.0.len()), (TASKS, TASKS));
    eprintln!("{} of {TASKS} transactions had no answer", unknown.load(Ordering::Relaxed));
}

/// Adds one to a counter, and creates a key that records it.
async fn increment(client: &Client, counter: &str, mark: &str, unknown: &AtomicUsize) {
    let read = vec![Op::Get(counter.to_owned()), Op::Get(mark.to_owned())];
    let mut txn = of(read.clone());
    loop {
        match client.transact(txn.clone()).await {
            Ok(outcome) if outcome.got.is_empty() => return,
            Ok(TransactionOutcome { got, .. }) => {
                let [counted, marked] = &got[..] else { panic!("{got:?}") };
                if marked.is_some() {
                    return;
                }
                let value = counted.as_ref().map_or(0, |kv| String::from_utf8_lossy(&kv.value).parse::<u64>().unwrap());
                let revision = counted.as_ref().map_or(0, |kv| kv.mod_revision);
                txn = Txn {
                    if_all: vec![Compare::ModRevision(counter.to_owned(), revision), Compare::Absent(mark.to_owned())],
                    then: vec![put(counter, &(value + 1).to_string(), None), put(mark, "", None)],
                    otherwise: read.clone(),
                };
            }
            // The same comparisons can't hold twice: the next answer reads what has become of it.
            Err(EtcdError::Unknown(_)) => _ = unknown.fetch_add(1, Ordering::Relaxed),
            Err(EtcdError::Unreachable(_)) => {}
            Err(EtcdError::Refused(why)) => panic!("{why}"),
        }
    }
}

/// Certificates of a CA of our own, for these addresses and for clients.
fn certify(folder: &Path, addresses: &[SocketAddr]) -> Certificates {
    let ca_key = KeyPair::generate().unwrap();
    let mut ca = CertificateParams::default();
    ca.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let ca_pem = ca.self_signed(&ca_key).unwrap().pem();
    let names: Vec<String> = addresses.iter().map(|address| address.ip().to_string()).collect();
    let mut params = CertificateParams::new(names).unwrap();
    // etcd takes a name for a user's.
    params.distinguished_name = DistinguishedName::new();
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
    let key = KeyPair::generate().unwrap();
    let cert = params.signed_by(&key, &Issuer::new(ca, ca_key)).unwrap();
    let write = |name: &str, text: String| {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    Certificates {
        ca: write("ca.pem", ca_pem),
        cert: write("cert.pem", cert.pem()),
        key: write("key.pem", key.serialize_pem()),
    }
}

#[tokio::test]
async fn certificates_and_passwords() {
    if !EtcdMembers::is_there() {
        return;
    }
    const PASSWORD: &str = "correct-horse";
    let folder = tempfile::tempdir().unwrap();
    let mut etcd = EtcdMembers::start_with(1, SHORT_TIMES, &[], |addresses| Some(certify(folder.path(), addresses)));
    let files = etcd.certificates().unwrap().clone();
    let bare = EtcdOptions { ca: Some(files.ca), ..options(&etcd) };
    let known = EtcdOptions { certificate: Some(files.cert), key: Some(files.key), ..bare.clone() };
    let anonymous = Client::open_within(&known, LIMIT).unwrap();
    make(&anonymous, "mine/1").await;

    // Without our certificate, or with another CA than etcd's, there is no connection.
    let unknown = Client::open_within(&bare, LIMIT).unwrap().get("mine/1").await;
    assert!(matches!(unknown, Err(EtcdError::Unreachable(_))), "{unknown:?}");
    let other = tempfile::tempdir().unwrap();
    let other = EtcdOptions { ca: Some(certify(other.path(), &[]).ca), ..known.clone() };
    let distrusted = Client::open_within(&other, LIMIT).unwrap().get("mine/1").await;
    assert!(matches!(&distrusted, Err(EtcdError::Unreachable(why)) if why.contains("certificate")), "{distrusted:?}");

    for arguments in [
        &["user", "add", "root:root"][..],
        &["role", "add", "root"],
        &["user", "grant-role", "root", "root"],
        &["user", "add", &format!("palpate:{PASSWORD}")],
        &["role", "add", "node"],
        &["role", "grant-permission", "node", "--prefix=true", "readwrite", "mine/"],
        &["user", "grant-role", "palpate", "node"],
        &["auth", "enable"],
    ] {
        etcd.control(arguments);
    }
    let unnamed = anonymous.get("mine/1").await;
    assert!(matches!(&unnamed, Err(EtcdError::Refused(why)) if why.contains("user of etcd")), "{unnamed:?}");

    let secret = folder.path().join("secret");
    std::fs::write(&secret, format!("{PASSWORD}\n")).unwrap();
    let named = EtcdOptions { user: Some("palpate".into()), password_file: Some(secret.clone()), ..known };
    let client = Client::open_within(&named, LIMIT).unwrap();
    assert!(client.get("mine/1").await.unwrap().0.is_some());
    let mut watch = client.watch("mine/", make(&client, "mine/2").await);
    assert_eq!(next(&mut watch).await.unwrap().len(), 1);
    let lease = client.grant(60).await.unwrap();
    assert_eq!(client.keep_alive(lease.id).await.unwrap(), Some(lease.ttl_s));

    // Keys of others.
    let others = client.get("yours/1").await;
    assert!(matches!(&others, Err(EtcdError::Refused(why)) if why.contains("permission denied")), "{others:?}");
    let others = next(&mut client.watch("yours/", 1)).await;
    assert!(matches!(&others, Err(WatchError::Refused(why)) if why.contains("permission denied")), "{others:?}");

    // etcd forgets tokens when it starts again: we get another, also for the watch.
    etcd.restart_all();
    make(&client, "mine/3").await;
    let batch = next(&mut watch).await.unwrap();
    assert!(matches!(&batch[..], [WatchEvent::Put(kv)] if kv.key == "mine/3"), "{batch:?}");
    assert_eq!(at_last(|| client.keep_alive(lease.id)).await, Some(lease.ttl_s));

    // A wrong password, which no message contains.
    std::fs::write(&secret, "wrong-horse").unwrap();
    let client = Client::open_within(&named, LIMIT).unwrap();
    let wrong = client.get("mine/1").await;
    assert!(matches!(&wrong, Err(EtcdError::Refused(why)) if why.contains("password")), "{wrong:?}");
    let shown = format!("{wrong:?} {client:?} {named:?} {watch:?}");
    assert!(!shown.contains("horse"), "{shown}");
}
