//! Authorization: TLS, tokens, certificates, and the settings without which a server does not start.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, mpsc};

use crate::common::authority::Authority;
use crate::common::server::{self, TEST_TIMEOUT, TestServer, force, palpate, repository, server_program, told};
use palpate::server::identity::{self, Access, CALLS, Role, access};
use palpate_proto::pb;
use prost::Message;
use rcgen::{CertificateParams, KeyPair};
use tokio::io::AsyncReadExt;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tonic::metadata::MetadataValue;
use tonic::transport::{Channel, ClientTlsConfig, Identity};
use tonic::{Code, Request, Status};
use tonic_types::StatusExt;

/// A token of some roles, added to the file.
fn token(file: &Path, name: &str, roles: &str) -> String {
    let made = palpate(&["token", "--name", name, "--role", roles, "--tokens", file.to_str().unwrap()]);
    assert!(made.status.success(), "{made:?}");
    String::from_utf8(made.stdout).unwrap().trim().to_owned()
}

fn with_token<T>(message: T, token: &str) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
    request
}

/// Calls `path` with an empty message; any answer is as good as another.
async fn call(channel: &Channel, path: &str, authorization: Option<&str>) -> Result<(), Status> {
    let mut grpc = tonic::client::Grpc::new(channel.clone());
    grpc.ready().await.unwrap();
    let mut request = Request::new(tokio_stream::once(()));
    if let Some(value) = authorization {
        request.metadata_mut().insert("authorization", value.parse().unwrap());
    }
    let codec = tonic_prost::ProstCodec::<(), ()>::default();
    let answer = grpc.streaming(request, path.parse().unwrap(), codec);
    let mut answer = tokio::time::timeout(TEST_TIMEOUT, answer).await.unwrap()?.into_inner();
    // Admitted streams may have nothing to send.
    tokio::select! {
        biased;
        message = answer.message() => message.map(|_| ()),
        () = tokio::time::sleep(std::time::Duration::from_millis(200)) => Ok(()),
    }
}

/// Every call of the server, by its path.
fn served() -> BTreeSet<String> {
    let mut paths = BTreeSet::new();
    let reflection =
        [tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET, tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET];
    for bytes in [pb::DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET].into_iter().chain(reflection) {
        for file in prost_types::FileDescriptorSet::decode(bytes).unwrap().file {
            for service in &file.service {
                for method in &service.method {
                    paths.insert(format!("/{}.{}/{}", file.package(), service.name(), method.name()));
                }
            }
        }
    }
    paths
}

#[test]
fn every_call_asks_for_a_role_or_says_that_it_is_open() {
    let served = served();
    assert!(served.len() > 15);
    for path in &served {
        let access = access(path).unwrap_or_else(|| panic!("{path} is in no row of server::identity::CALLS"));
        assert_eq!(access == Access::Open, path.starts_with("/grpc."), "{path}");
    }
    for (path, _) in CALLS {
        assert!(served.contains(*path), "there is no call {path}");
    }
}

#[tokio::test]
async fn a_client_without_a_token_is_told_how_to_give_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    token(&file, "ann", "watch");
    let server = TestServer::start(&["--tokens", file.to_str().unwrap()]);
    for arguments in
        [&["top", "--once"][..], &["bridge", "--seconds", "1"], &["admin", "callers"], &["replay", "press"]]
    {
        let mut command = Command::new(server::client_program());
        command.args(arguments).args(["--server", &server.url]).env_remove("PALPATE_TOKEN");
        let ran = command.current_dir(repository()).output().unwrap();
        let said = String::from_utf8_lossy(&ran.stderr);
        assert!(!ran.status.success() && said.contains("UNAUTHENTICATED"), "{arguments:?}: {said}");
        assert!(said.contains("--token-file FILE") && said.contains("PALPATE_TOKEN"), "{arguments:?}: {said}");
    }
}

#[tokio::test]
async fn every_call_is_refused_without_a_token_with_a_wrong_one_and_with_too_weak_a_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    let tokens: Vec<_> = Role::ALL.iter().map(|role| (*role, token(&file, role.name(), role.name()))).collect();
    let server = TestServer::start(&["--tokens", file.to_str().unwrap()]);
    let channel = server.channel().await;
    let reason = |status: &Status| status.get_details_error_info().map(|info| info.reason).unwrap_or_default();
    for path in served() {
        let Some(Access::Role(needed)) = access(&path) else {
            // An open call may be refused for its content, not for its caller.
            if let Err(status) = call(&channel, &path, None).await {
                assert!(
                    ![Code::Unauthenticated, Code::PermissionDenied].contains(&status.code()),
                    "{path}: {status:?}"
                );
            }
            continue;
        };
        let wrong = format!("Bearer {}", identity::new_token().unwrap());
        let basic = format!("Basic {}", tokens[3].1);
        for authorization in
            [None, Some(wrong.as_str()), Some(basic.as_str()), Some("Bearer"), Some("Bearer "), Some("")]
        {
            let status = call(&channel, &path, authorization).await.expect_err(&path);
            assert_eq!(told(&status).0, Code::Unauthenticated, "{path}, {authorization:?}");
            assert_eq!(reason(&status), "UNAUTHENTICATED", "{path}, {authorization:?}");
        }
        for (role, token) in &tokens {
            // Calls between servers of a fleet are for no other role.
            let administers = *role == Role::Administer && needed != Role::Node;
            let enough = needed == Role::Watch || *role == needed || administers;
            let called = call(&channel, &path, Some(&format!("bearer {token}"))).await;
            let refused = called
                .err()
                .filter(|status| status.code() == Code::Unauthenticated || reason(status) == "ROLE_MISSING");
            match refused {
                Some(status) => {
                    assert!(!enough, "{path} as {role:?}: {status:?}");
                    assert_eq!(told(&status).0, Code::PermissionDenied);
                }
                None => assert!(enough, "{path} is let through as {role:?}"),
            }
        }
    }
    // A call of the protocol's package that the server does not implement is refused too.
    let status = call(&channel, "/palpate.v1.SessionService/Forgotten", Some(&format!("Bearer {}", tokens[3].1))).await;
    assert_eq!(told(&status.unwrap_err()), (Code::PermissionDenied, "ROLE_MISSING".into(), String::new()));
}

#[tokio::test]
async fn a_lease_is_of_no_use_to_whom_it_was_not_given() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    let (owner, thief) = (token(&file, "owner", "create,touch"), token(&file, "thief", "touch"));
    let server = TestServer::start(&["--tokens", file.to_str().unwrap()]);
    let (mut sessions, mut haptics) = (server.sessions().await, server.haptics().await);
    let source = Some(pb::create_session_request::Source::SceneName("paper".into()));
    let create = pb::CreateSessionRequest { source, paused: true, idle_timeout_s: None };
    let session = sessions.create_session(with_token(create, &owner)).await.unwrap().into_inner().session.unwrap();
    let id = session.session_id;
    let acquire = pb::AcquireToolRequest {
        session_id: id.clone(),
        tool: 0,
        lease_s: Some(60.0),
        holder: "owner".into(),
        ..Default::default()
    };
    let lease_id = haptics.acquire_tool(with_token(acquire.clone(), &owner)).await.unwrap().into_inner().lease_id;
    // All that can be seen of the session, without the id of the lease.
    let seen = pb::GetSessionRequest { session_id: id.clone() };
    let seen = sessions.get_session(with_token(seen, &thief)).await.unwrap().into_inner();
    assert!(!format!("{seen:?}").contains(&lease_id));
    let taken = haptics.acquire_tool(with_token(acquire, &thief)).await.unwrap_err();
    assert_eq!(told(&taken).1, "TOOL_HELD");
    let near = |lease: &str| format!("{:032x}", u128::from_str_radix(lease, 16).unwrap() ^ 1);
    for guess in ["", "0", &id, &near(&lease_id)] {
        let commands = vec![force(0, 1, -1.0)];
        let send = pb::SendCommandsRequest { session_id: id.clone(), lease_id: guess.to_owned(), commands };
        let sent = haptics.send_commands(with_token(send, &thief)).await.unwrap_err();
        assert_eq!((sent.code(), told(&sent).1.as_str()), (Code::PermissionDenied, "NOT_HOLDER"), "{guess}");
        let release = pb::ReleaseToolRequest { session_id: id.clone(), lease_id: guess.to_owned() };
        let released = haptics.release_tool(with_token(release, &thief)).await.unwrap_err();
        assert_eq!(told(&released).1, "NOT_HOLDER", "{guess}");
    }
    let delete = pb::DeleteSessionRequest { session_id: id.clone() };
    assert_eq!(told(&sessions.delete_session(with_token(delete, &thief)).await.unwrap_err()).1, "ROLE_MISSING");
    // It is the owner's still.
    let commands = vec![force(0, 1, -1.0)];
    let send = pb::SendCommandsRequest { session_id: id, lease_id, commands };
    haptics.send_commands(with_token(send, &owner)).await.unwrap();
}

#[tokio::test]
async fn tokens_come_and_go_while_the_server_runs() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    let first = token(&file, "first", "watch");
    let before = std::fs::read_to_string(&file).unwrap();
    let (server, log) = start_logged(&["--tokens", file.to_str().unwrap()]);
    let channel = server.channel().await;
    let list = "/palpate.v1.SessionService/ListScenes";
    let is_known = async |token: &str| call(&channel, list, Some(&format!("Bearer {token}"))).await.is_ok();
    let second = token(&file, "second", "watch");
    log.wait_for("new files are in use");
    assert!(is_known(&first).await && is_known(&second).await);
    std::fs::write(&file, before.replace("watch", "wach")).unwrap();
    log.wait_for("the old ones stay in use");
    assert!(is_known(&first).await && is_known(&second).await);
    std::fs::write(&file, &before).unwrap();
    log.wait_for("new files are in use");
    assert!(is_known(&first).await && !is_known(&second).await);
}

/// A server with a session, and two who know it: one of them is struck from the file when `before` is written there.
struct Two {
    _folder: tempfile::TempDir,
    file: std::path::PathBuf,
    before: String,
    stays: String,
    goes: String,
    server: TestServer,
    log: Log,
    session: String,
}

async fn two_tokens() -> Two {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    let stays = token(&file, "stays", "create,touch");
    let before = std::fs::read_to_string(&file).unwrap();
    let goes = token(&file, "goes", "touch");
    let (server, log) = start_logged(&["--tokens", file.to_str().unwrap()]);
    let source = Some(pb::create_session_request::Source::SceneName("paper".into()));
    let request = pb::CreateSessionRequest { source, ..Default::default() };
    let created = server.sessions().await.create_session(with_token(request, &stays)).await.unwrap();
    let session = created.into_inner().session.unwrap().session_id;
    Two { _folder: folder, file, before, stays, goes, server, log, session }
}

#[tokio::test]
async fn who_loses_a_token_loses_the_streams_and_tools_that_it_opened() {
    let Two { _folder, file, before, stays, goes, server, log, session } = two_tokens().await;
    let open = async |tool: u32, token: &str| {
        let (sender, receiver) = tokio::sync::mpsc::channel(4);
        let message = Some(pb::touch_request::Message::Open(server::open(&session, &[tool])));
        sender.send(pb::TouchRequest { message }).await.unwrap();
        let outbound = tokio_stream::wrappers::ReceiverStream::new(receiver);
        let mut inbound = server.haptics().await.touch(with_token(outbound, token)).await.unwrap().into_inner();
        inbound.message().await.unwrap().unwrap();
        (sender, inbound)
    };
    let (_sender, mut lost) = open(0, &goes).await;
    let (_other, mut kept) = open(1, &stays).await;
    std::fs::write(&file, &before).unwrap();
    log.wait_for("new files are in use");
    let ended = loop {
        if let Err(status) = tokio::time::timeout(TEST_TIMEOUT, lost.message()).await.unwrap().map(Option::unwrap) {
            break status;
        }
    };
    assert_eq!(ended.code(), Code::Unauthenticated, "{ended}");
    // A caller with the right takes the tool, and other callers continue.
    let mut haptics = server.haptics().await;
    let begun = std::time::Instant::now();
    loop {
        let request = pb::AcquireToolRequest { session_id: session.clone(), tool: 0, ..Default::default() };
        match haptics.acquire_tool(with_token(request, &stays)).await {
            Ok(_) => break,
            Err(status) => assert!(begun.elapsed() < TEST_TIMEOUT, "{status}"),
        }
    }
    for _ in 0..3 {
        kept.message().await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn who_loses_a_token_loses_the_tools_that_outlive_its_calls() {
    let Two { _folder, file, before, stays, goes, server, log, session } = two_tokens().await;
    let mut haptics = server.haptics().await;
    // Leases of ten minutes, whatever becomes of the connection.
    let mut acquire = async |tool: u32, token: &str| {
        let (session_id, lease_s, outlives_connection) = (session.clone(), Some(600.0), true);
        let request = pb::AcquireToolRequest { session_id, tool, lease_s, outlives_connection, ..Default::default() };
        haptics.acquire_tool(with_token(request, token)).await.unwrap().into_inner().lease_id
    };
    let (lost, kept) = (acquire(0, &goes).await, acquire(1, &stays).await);
    let send = async |tool: u32, sequence: u64, lease_id: &str, token: &str| {
        let commands = vec![force(tool, sequence, -1.0)];
        let request = pb::SendCommandsRequest { session_id: session.clone(), lease_id: lease_id.into(), commands };
        server.haptics().await.send_commands(with_token(request, token)).await
    };
    send(0, 1, &lost, &goes).await.unwrap();
    std::fs::write(&file, &before).unwrap();
    log.wait_for("tools released");
    let request = pb::GetSessionRequest { session_id: session.clone() };
    let told = server.sessions().await.get_session(with_token(request, &stays)).await.unwrap();
    let held: Vec<u32> = told.into_inner().session.unwrap().held_tools.iter().map(|held| held.tool).collect();
    assert_eq!(held, [1]);
    // The lease is useless to others, and the other lease works.
    assert_eq!(send(0, 2, &lost, &stays).await.unwrap_err().code(), Code::PermissionDenied);
    send(1, 1, &kept, &stays).await.unwrap();
}

/// A haptic stream of whom a token was given, over a connection whose transport lets so many bytes of answers in.
async fn touch_with(
    server: &TestServer,
    token: &str,
    session: &str,
    window_bytes: u32,
) -> (tokio::sync::mpsc::Sender<pb::TouchRequest>, Channel, tonic::Streaming<pb::TouchResponse>) {
    let endpoint = Channel::from_shared(server.url.clone()).unwrap();
    let channel = endpoint.initial_stream_window_size(window_bytes).connect().await.unwrap();
    let (sender, receiver) = tokio::sync::mpsc::channel(4);
    let message = Some(pb::touch_request::Message::Open(server::open(session, &[0])));
    sender.send(pb::TouchRequest { message }).await.unwrap();
    let outbound = tokio_stream::wrappers::ReceiverStream::new(receiver);
    let mut haptics = pb::haptic_service_client::HapticServiceClient::new(channel.clone());
    let inbound = haptics.touch(with_token(outbound, token)).await.unwrap().into_inner();
    (sender, channel, inbound)
}

#[tokio::test]
async fn who_loses_a_token_and_does_not_read_commands_nothing_more() {
    let Two { _folder, file, before, stays, goes, server, log, session } = two_tokens().await;
    let status = async || {
        let request = pb::GetSessionRequest { session_id: session.clone() };
        let told = server.sessions().await.get_session(with_token(request, &stays)).await.unwrap();
        told.into_inner().session.unwrap()
    };
    // Unread data fills the window; commands continue.
    let (sender, _channel, _unread) = touch_with(&server, &goes, &session, 1).await;
    let mut sequence = 0;
    let command = async |sequence: u64| {
        let message = Some(pb::touch_request::Message::Command(force(0, sequence, -1.0)));
        tokio::time::timeout(TEST_TIMEOUT, sender.send(pb::TouchRequest { message })).await.unwrap().is_ok()
    };
    while status().await.commands.unwrap().applied < 20 {
        sequence += 1;
        assert!(command(sequence).await);
    }
    std::fs::write(&file, &before).unwrap();
    log.wait_for("call ended");
    let accepted = status().await.commands.unwrap().accepted;
    // Both directions end, though nothing was read.
    loop {
        sequence += 1;
        if !command(sequence).await {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(1)).await;
    }
    log.wait_for("it does not read that its call is over");
    let after = status().await;
    assert!(after.held_tools.is_empty(), "{after:?}");
    assert_eq!(after.commands.unwrap().accepted, accepted);
}

#[cfg(unix)]
#[tokio::test]
async fn tokens_that_can_not_be_read_are_told_of_and_the_old_ones_hold() {
    use tonic_health::ServingStatus::{self, NotServing, Serving};
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_client::HealthClient;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    let known = token(&file, "known", "watch");
    let text = std::fs::read_to_string(&file).unwrap();
    let (server, _log) = start_logged(&["--tokens", file.to_str().unwrap()]);
    let channel = server.channel().await;
    let mut health = HealthClient::new(channel.clone());
    let request = |service: &str| HealthCheckRequest { service: service.into() };
    let mut watching = health.watch(request("palpate.tokens")).await.unwrap().into_inner();
    // Between two changes of the file the server may see a third state, and logs that too.
    let mut tells = async |status: ServingStatus, when: &str| {
        let told = async { while watching.message().await.unwrap().unwrap().status != status as i32 {} };
        tokio::time::timeout(TEST_TIMEOUT, told).await.unwrap_or_else(|_| panic!("{status:?} is not told {when}"));
    };
    tells(Serving, "at first").await;
    let list = "/palpate.v1.SessionService/ListScenes";
    let is_known = async || call(&channel, list, Some(&format!("Bearer {known}"))).await.is_ok();
    let remove = || std::fs::remove_file(&file).unwrap();
    let cases: [(&str, &dyn Fn()); 4] = [
        ("a pipe", &|| {
            remove();
            assert!(Command::new("mkfifo").arg(&file).status().unwrap().success());
        }),
        ("nothing", &remove),
        ("being written", &|| std::fs::write(&file, "").unwrap()),
        ("nonsense", &|| std::fs::write(&file, "[[tok").unwrap()),
    ];
    for (what, spoil) in cases {
        spoil();
        tells(NotServing, what).await;
        assert!(is_known().await, "{what}");
        assert_eq!(health.check(request("")).await.unwrap().into_inner().status, Serving as i32, "{what}");
        let _ = std::fs::remove_file(&file);
        std::fs::write(&file, &text).unwrap();
        tells(Serving, &format!("after {what}")).await;
    }
    // A readable file without tokens admits no caller.
    std::fs::write(&file, "# nobody\n").unwrap();
    let waited = tokio::time::timeout(TEST_TIMEOUT, async { while is_known().await {} });
    waited.await.expect("a token that is not in the file is known");
}

#[cfg(unix)]
#[test]
fn signals_that_mean_nothing_to_a_server_do_not_end_it_and_a_hangup_has_it_look() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens.toml");
    token(&file, "known", "watch");
    let (mut server, log) = start_logged(&["--tokens", file.to_str().unwrap()]);
    let id = server.child.id().to_string();
    let send = |signal: &str| assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
    ["-USR1", "-USR2", "-XFSZ"].into_iter().for_each(send);
    // A hangup just after the start comes before anything waits for it: the files have only just been read.
    let begun = std::time::Instant::now();
    while !log.tells("SIGHUP: checking the files", std::time::Duration::from_secs(1)) {
        assert!(begun.elapsed() < TEST_TIMEOUT, "a hangup is not heard");
        send("-HUP");
    }
    assert_eq!(server.child.try_wait().unwrap(), None);
}

#[tokio::test]
async fn a_certificate_near_its_end_is_warned_of() {
    let authority = Authority::new();
    let folder = tempfile::tempdir().unwrap();
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    let today = rcgen::date_time_ymd(1970, 1, 1) + now;
    for (name, ends, told) in [
        ("soon", today + std::time::Duration::from_secs(3 * 86_400 + 3600), "expires in 3 days"),
        ("over", today - std::time::Duration::from_secs(86_400), "has expired"),
    ] {
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        params.not_after = ends;
        let key = KeyPair::generate().unwrap();
        let cert = params.signed_by(&key, &authority.issuer).unwrap();
        let names = [format!("{name}.pem"), format!("{name}.key")];
        let [cert, key] = write(folder.path(), [(&names[0], &cert.pem()), (&names[1], &key.serialize_pem())]);
        let (_server, log) = start_logged(&["--tls-cert", &cert, "--tls-key", &key]);
        log.wait_for(told);
    }
}

/// Log of a running server.
struct Log(mpsc::Receiver<String>);

impl Log {
    /// Returns whether it contains such a line before a silence of `silence`.
    fn tells(&self, text: &str, silence: std::time::Duration) -> bool {
        std::iter::from_fn(|| self.0.recv_timeout(silence).ok()).any(|line| line.contains(text))
    }

    fn wait_for(&self, text: &str) {
        while !self.0.recv_timeout(TEST_TIMEOUT).unwrap_or_else(|_| panic!("the log lacks `{text}`")).contains(text) {}
    }
}

fn start_logged(arguments: &[&str]) -> (TestServer, Log) {
    let mut server = TestServer::start(arguments);
    let (lines, log) = mpsc::channel();
    let stderr = BufReader::new(server.child.stderr.take().unwrap());
    std::thread::spawn(move || stderr.lines().map_while(Result::ok).try_for_each(|line| lines.send(line)));
    (server, Log(log))
}

/// Writes files of a folder. Returns their paths.
fn write<const N: usize>(folder: &Path, files: [(&str, &str); N]) -> [String; N] {
    files.map(|(name, text)| {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    })
}

async fn connect(url: &str, tls: ClientTlsConfig) -> Result<Channel, tonic::transport::Error> {
    Channel::from_shared(url.to_owned()).unwrap().tls_config(tls)?.connect().await
}

const SCENES: &str = "/palpate.v1.SessionService/ListScenes";
const SESSIONS: &str = "/palpate.v1.SessionService/ListSessions";

#[tokio::test]
async fn a_client_certificate_that_is_missing_or_of_somebody_else_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (authority, stranger) = (Authority::new(), Authority::new());
    let (cert, key) = authority.sign(None);
    let known = "[[certificate]]\nname = \"bench-3\"\nroles = [\"touch\"]\n";
    let files = [("cert.pem", &*cert), ("key.pem", &key), ("ca.pem", &authority.pem), ("tokens.toml", known)];
    let [cert, key, ca, tokens] = write(folder.path(), files);
    let mutual = ["--tls-cert", &cert, "--tls-key", &key, "--tls-client-ca", &ca];
    let identity = |authority: &Authority, name: &str| {
        let (cert, key) = authority.sign(Some(name));
        Identity::from_pem(cert, key)
    };
    // Without a file of roles a certificate is enough.
    let server = TestServer::start(&mutual);
    assert!(server.url.starts_with("https://"));
    let channel = connect(&server.url, authority.trust().identity(identity(&authority, "anybody"))).await.unwrap();
    call(&channel, SESSIONS, None).await.unwrap();
    let refused = [
        connect(&server.url, authority.trust()).await,
        connect(&server.url, authority.trust().identity(identity(&stranger, "anybody"))).await,
        connect(&server.url, stranger.trust().identity(identity(&authority, "anybody"))).await,
        Channel::from_shared(server.url.replace("https", "http")).unwrap().connect().await,
    ];
    // In TLS 1.3 a client learns about its refused certificate only after the handshake.
    for channel in refused.into_iter().flatten() {
        let status = call(&channel, "/grpc.health.v1.Health/Check", None).await.unwrap_err();
        assert!(status.get_details_error_info().is_none(), "{status:?}");
    }
    drop(server);
    // With one, it is the names in it that count.
    let server = TestServer::start(&[&mutual[..], &["--tokens", &tokens]].concat());
    let channel = connect(&server.url, authority.trust().identity(identity(&authority, "bench-3"))).await.unwrap();
    call(&channel, SCENES, None).await.unwrap();
    assert_eq!(told(&call(&channel, SESSIONS, None).await.unwrap_err()).1, "ROLE_MISSING");
    let channel = connect(&server.url, authority.trust().identity(identity(&authority, "bench-4"))).await.unwrap();
    let refused = call(&channel, SCENES, None).await.unwrap_err();
    assert_eq!(told(&refused), (Code::Unauthenticated, "UNAUTHENTICATED".into(), "authorization".into()));
}

#[tokio::test]
async fn new_certificates_are_shown_without_a_restart_and_bad_ones_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let (old, new) = (Authority::new(), Authority::new());
    let ((old_cert, old_key), (new_cert, new_key)) = (old.sign(None), new.sign(None));
    let [cert, key] = write(folder.path(), [("cert.pem", &old_cert), ("key.pem", &old_key)]);
    let (server, log) = start_logged(&["--tls-cert", &cert, "--tls-key", &key]);
    let kept = connect(&server.url, old.trust()).await.unwrap();
    assert!(connect(&server.url, new.trust()).await.is_err());
    // A certificate without its key.
    std::fs::write(&cert, &new_cert).unwrap();
    log.wait_for("the old ones stay in use");
    assert!(connect(&server.url, old.trust()).await.is_ok() && connect(&server.url, new.trust()).await.is_err());
    std::fs::write(&key, &new_key).unwrap();
    log.wait_for("new files are in use");
    assert!(connect(&server.url, old.trust()).await.is_err() && connect(&server.url, new.trust()).await.is_ok());
    // Existing connections continue.
    call(&kept, SCENES, None).await.unwrap();
}

#[tokio::test]
async fn a_connection_through_tls_that_says_nothing_is_closed_before_its_handshake_and_after() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (cert, key) = authority.sign(None);
    let config = "[limits]\nhandshake_s = 1.0\n";
    let [cert, key, config] = write(folder.path(), [("cert.pem", &*cert), ("key.pem", &key), ("palpate.toml", config)]);
    let server = TestServer::start(&["--config", &config, "--tls-cert", &cert, "--tls-key", &key]);
    let address = server.url.trim_start_matches("https://").to_owned();
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(authority.pem.as_bytes()).unwrap()).unwrap();
    let client = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let connector = TlsConnector::from(Arc::new(client));
    let ended = async {
        let mut silent = tokio::net::TcpStream::connect(&address).await.unwrap();
        assert!(silent.read_u8().await.is_err());
        // A machine that is very busy may miss the deadline for the handshake itself.
        let mut secured = loop {
            let socket = tokio::net::TcpStream::connect(&address).await.unwrap();
            if let Ok(secured) = connector.connect("127.0.0.1".try_into().unwrap(), socket).await {
                break secured;
            }
        };
        let mut heard = Vec::new();
        // By an end or a reset.
        let _ = secured.read_to_end(&mut heard).await;
    };
    tokio::time::timeout(TEST_TIMEOUT, ended).await.expect("what says nothing is kept");
}

#[test]
fn a_server_that_others_can_reach_does_not_start_unprotected() {
    let folder = tempfile::tempdir().unwrap();
    let (cert, key) = Authority::new().sign(None);
    let [cert, key] = write(folder.path(), [("cert.pem", &cert), ("key.pem", &key)]);
    let tokens = folder.path().join("tokens.toml");
    token(&tokens, "somebody", "watch");
    let tokens = tokens.to_str().unwrap();
    let (tls, known) = (["--tls-cert", &cert, "--tls-key", &key], ["--tokens", tokens]);
    let anywhere = ["serve", "--listen", "0.0.0.0:0"];
    for (more, why) in [(&[][..], "neither TLS nor tokens"), (&tls[..], "authenticate"), (&known[..], "in the clear")] {
        let ended = palpate(&[&anywhere[..], more].concat());
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(2), "{said}");
        for word in [why, "--tls-cert", "--tokens", "--insecure"] {
            assert!(said.contains(word), "{said} lacks {word}");
        }
        assert!(ended.stdout.is_empty());
    }
    let ended = palpate(&["serve", "--listen", "127.0.0.1:0", "--metrics", "0.0.0.0:0"]);
    assert_eq!(ended.status.code(), Some(2));
    for more in [&["--insecure"][..], &[&tls[..], &known[..]].concat()] {
        let mut child = Command::new(server_program())
            .args(anywhere)
            .args(more)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let _ = child.kill();
        child.wait().unwrap();
        assert!(line.contains("://0.0.0.0:"), "{line}");
    }
}

#[test]
fn files_that_make_no_sense_are_refused_with_their_names() {
    let folder = tempfile::tempdir().unwrap();
    let (cert, key) = Authority::new().sign(None);
    let secret = identity::new_token().unwrap();
    let short = "[[token]]\nname = \"a\"\nroles = [\"watch\"]\nsha256 = \"12\"\n";
    let entry = identity::entry("a", &[Role::Watch], &secret).unwrap();
    let files = [
        ("cert.pem", cert.clone()),
        ("key.pem", key),
        ("other.pem", Authority::new().sign(None).1),
        ("empty.pem", String::new()),
        ("short.toml", short.into()),
        ("twice.toml", entry.repeat(2)),
        ("roles.toml", entry.replace("\"watch\"", "")),
        ("plain.toml", format!("token = \"{secret}\"\n")),
        ("misplaced.toml", short.replace("12", &secret)),
    ];
    let path = |name: &str| -> PathBuf { folder.path().join(name) };
    files.iter().for_each(|(name, text)| std::fs::write(path(name), text).unwrap());
    for (options, told) in [
        (vec![("--tls-cert", "cert.pem")], "tls_key"),
        (vec![("--tls-key", "key.pem")], "tls_cert"),
        (vec![("--tls-client-ca", "cert.pem")], "tls_cert"),
        (vec![("--tls-cert", "cert.pem"), ("--tls-key", "other.pem")], "other.pem"),
        (vec![("--tls-cert", "cert.pem"), ("--tls-key", "cert.pem")], "cert.pem: is not a private key"),
        (vec![("--tls-cert", "empty.pem"), ("--tls-key", "key.pem")], "empty.pem: has no certificate"),
        (vec![("--tls-cert", "absent.pem"), ("--tls-key", "key.pem")], "absent.pem"),
        (vec![("--tokens", "short.toml")], "token[0].sha256"),
        (vec![("--tokens", "twice.toml")], "token[1].sha256"),
        (vec![("--tokens", "roles.toml")], "roles"),
        (vec![("--tokens", "plain.toml")], "plain.toml:1"),
        (vec![("--tokens", "misplaced.toml")], "token[0].sha256"),
        (vec![("--tokens", "absent.toml")], "absent.toml"),
    ] {
        let mut arguments = vec!["serve".to_owned(), "--listen".to_owned(), "127.0.0.1:0".to_owned()];
        for (option, name) in &options {
            arguments.extend([(*option).to_owned(), path(name).to_str().unwrap().to_owned()]);
        }
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let ended = palpate(&arguments);
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(2), "{options:?}: {said}");
        assert!(said.contains(told), "{options:?}: {said}");
        assert!(!said.contains(&secret), "{said}");
    }
    let ended = palpate(&["token", "--name", "a", "--role", "watcher"]);
    assert_eq!(ended.status.code(), Some(2));
    assert!(String::from_utf8(ended.stderr).unwrap().contains("watch, touch, create, administer"));
}

#[tokio::test]
async fn no_secret_gets_into_the_log_however_much_is_logged() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (cert, key) = authority.sign(None);
    let [cert, key_path] = write(folder.path(), [("cert.pem", &cert), ("key.pem", &key)]);
    let file = folder.path().join("tokens.toml");
    let (good, wrong) = (token(&file, "good", "administer"), identity::new_token().unwrap());
    let arguments = ["--tls-cert", &cert, "--tls-key", &key_path, "--tokens", file.to_str().unwrap(), "--log", "trace"];
    let mut server = TestServer::start(&arguments);
    let mut stderr = server.child.stderr.take().unwrap();
    let reading = std::thread::spawn(move || {
        let mut log = String::new();
        stderr.read_to_string(&mut log).unwrap();
        log
    });
    let channel = connect(&server.url, authority.trust()).await.unwrap();
    let mut sessions = pb::session_service_client::SessionServiceClient::new(channel.clone());
    let mut haptics = pb::haptic_service_client::HapticServiceClient::new(channel.clone());
    let source = Some(pb::create_session_request::Source::SceneName("paper".into()));
    let create = pb::CreateSessionRequest { source, paused: true, idle_timeout_s: None };
    let session = sessions.create_session(with_token(create, &good)).await.unwrap().into_inner().session.unwrap();
    let acquire = pb::AcquireToolRequest { session_id: session.session_id, ..Default::default() };
    let lease_id = haptics.acquire_tool(with_token(acquire, &good)).await.unwrap().into_inner().lease_id;
    let mut sensitive = Request::new(pb::ListScenesRequest {});
    let mut value: MetadataValue<_> = format!("Bearer {wrong}").parse().unwrap();
    value.set_sensitive(true);
    sensitive.metadata_mut().insert("authorization", value);
    sessions.list_scenes(sensitive).await.unwrap_err();
    sessions.list_scenes(with_token(pb::ListScenesRequest {}, &wrong)).await.unwrap_err();
    // Ended in good order it writes all that it has logged.
    assert!(Command::new("kill").args(["-TERM", &server.child.id().to_string()]).status().unwrap().success());
    let log = reading.join().unwrap();
    assert!(log.contains("call refused") && log.contains("tools acquired"), "{log}");
    let inside = key.lines().nth(1).unwrap();
    for secret in [&*good, &wrong, &lease_id, inside] {
        assert!(!log.contains(secret), "the log has {secret}: {log}");
    }
}

/// Returns a server's answer to a request in HTTP/1.1.
fn ask(url: &str, head: &str) -> String {
    let mut stream = std::net::TcpStream::connect(url.trim_start_matches("http://")).unwrap();
    stream.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
    write!(stream, "{head}\r\nHost: tissue\r\nContent-Length: 0\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer.to_lowercase()
}

#[test]
fn pages_of_other_sites_may_call_only_if_the_configuration_says_so() {
    let preflight = |origin: &str| {
        format!(
            "OPTIONS {SCENES} HTTP/1.1\r\nOrigin: {origin}\r\nAccess-Control-Request-Method: POST\r\n\
             Access-Control-Request-Headers: content-type,x-grpc-web,authorization"
        )
    };
    let post = |origin: &str| format!("POST {SCENES} HTTP/1.1\r\nOrigin: {origin}\r\nContent-Type: application/grpc");
    let server = TestServer::start(&["--origin", "https://viewer.example", "--origin", "http://other.example:8080"]);
    for origin in ["https://viewer.example", "http://other.example:8080"] {
        let answer = ask(&server.url, &preflight(origin));
        assert!(answer.contains(&format!("access-control-allow-origin: {origin}\r\n")), "{answer}");
        assert!(answer.contains("authorization") && answer.contains("x-grpc-web"), "{answer}");
        let answer = ask(&server.url, &post(origin));
        assert!(answer.contains("access-control-expose-headers: grpc-status,grpc-message"), "{answer}");
        assert!(!answer.contains("origin_not_allowed"), "{answer}");
    }
    assert!(!ask(&server.url, &preflight("https://evil.example")).contains("access-control-allow-origin"));
    // A name that was given this machine's address: for the browser, a page of this server.
    let answer = ask(&server.url, &post("http://evil.example:7117"));
    assert!(answer.contains("grpc-status: 7") && answer.contains("configuration"), "{answer}");
    let answer = ask(&server.url, &post(&server.url));
    assert!(!answer.contains("grpc-status: 7"), "{answer}");
    let plain = TestServer::start(&[]);
    assert!(!ask(&plain.url, &preflight("https://viewer.example")).contains("access-control-allow-origin"));
}

#[test]
fn the_clients_programs_show_their_token_and_check_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (cert, key) = authority.sign(None);
    let (own_cert, own_key) = authority.sign(Some("bench-3"));
    let files = [
        ("cert.pem", &*cert),
        ("key.pem", &key),
        ("ca.pem", &authority.pem),
        ("own.pem", &own_cert),
        ("own.key", &own_key),
        ("stranger.pem", &Authority::new().pem),
    ];
    let [cert, key, ca, own_cert, own_key, stranger] = write(folder.path(), files);
    let file = folder.path().join("tokens.toml");
    let [strong, weak] = [("strong", "create,touch"), ("weak", "watch")].map(|(name, roles)| {
        let [path] = write(folder.path(), [(name, &token(&file, name, roles))]);
        path
    });
    let arguments = ["--tls-cert", &cert, "--tls-key", &key, "--tls-client-ca", &ca];
    let server = TestServer::start(&[&arguments[..], &["--tokens", file.to_str().unwrap()]].concat());
    let replay = |more: &[&str], environment: Option<&str>| {
        let mut command = Command::new(server::client_program());
        command.args(["replay", "scripts/vertical-60.toml", "--quiet"]).args(more);
        if !more.contains(&"--server") {
            command.args(["--server", &server.url]);
        }
        command.current_dir(repository()).env_remove("PALPATE_TOKEN");
        if let Some(token) = environment {
            command.env("PALPATE_TOKEN", token);
        }
        let ended = command.output().unwrap();
        (ended.status.code(), String::from_utf8(ended.stderr).unwrap())
    };
    let own = ["--ca", &ca, "--cert", &own_cert, "--key", &own_key];
    let text = std::fs::read_to_string(&strong).unwrap();
    let strong_file = [&own[..], &["--token-file", &strong]].concat();
    let (status, said) = replay(&strong_file, None);
    assert_eq!(status, Some(0), "{said}");
    assert_eq!(replay(&own, Some(&text)).0, Some(0));
    let (status, said) = replay(&[&own[..], &["--token-file", &weak]].concat(), None);
    assert!(status == Some(1) && said.contains("ROLE_MISSING"), "{said}");
    let (status, said) = replay(&own, None);
    assert!(status == Some(1) && said.contains("UNAUTHENTICATED"), "{said}");
    let (status, said) = replay(&["--ca", &stranger, "--token-file", &strong], None);
    assert!(status == Some(1) && said.contains("can't reach"), "{said}");
    // A token does not leave this machine in the clear.
    let (status, said) = replay(&["--server", "http://192.0.2.1:7117", "--token-file", &strong], None);
    assert!(status == Some(2) && said.contains("in the clear"), "{said}");
}

#[cfg(unix)]
#[test]
fn a_certificate_for_trials_serves_and_the_wrong_scheme_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().to_str().unwrap();
    let [cert, key] = ["cert.pem", "key.pem"].map(|name| folder.path().join(name).to_str().unwrap().to_owned());
    // A key that others could read is not written over, but replaced.
    std::fs::write(&key, "old").unwrap();
    let refused = palpate(&["certificate", "--dir", dir]);
    assert_eq!(refused.status.code(), Some(2));
    let said = String::from_utf8(refused.stderr).unwrap();
    assert!(said.contains("key.pem: exists already; --force overwrites it"), "{said}");
    assert_eq!(std::fs::read_to_string(&key).unwrap(), "old");
    let made = palpate(&["certificate", "localhost", "127.0.0.1", "--dir", dir, "--force"]);
    let told = String::from_utf8(made.stdout).unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    assert!(told.contains("palpate serve --listen 127.0.0.1:7117 --tls-cert ") && told.contains(" --ca "), "{told}");
    assert_eq!(std::fs::metadata(&key).unwrap().permissions().mode() & 0o777, 0o600);
    let wrong = palpate(&["certificate", "https://server", "--dir", dir, "--force"]);
    assert_eq!(wrong.status.code(), Some(2));

    let health = |arguments: &[&str]| {
        let ended = Command::new(server::client_program()).arg("health").args(arguments).output().unwrap();
        (ended.status.code(), String::from_utf8(ended.stderr).unwrap())
    };
    let secure = TestServer::start(&["--tls-cert", &cert, "--tls-key", &key]);
    let address = secure.url.strip_prefix("https://").unwrap();
    for name in ["localhost", "127.0.0.1"] {
        let url = format!("https://{}", address.replace("127.0.0.1", name));
        let (status, said) = health(&[&url, "--ca", &cert]);
        assert_eq!(status, Some(0), "{name}: {said}");
    }
    let (status, said) = health(&[&format!("http://{address}")]);
    assert_eq!(status, Some(1));
    assert!(said.contains(&format!("the server at {address} speaks TLS: use https://{address}")), "{said}");
    let plain = TestServer::start(&[]);
    let address = plain.url.strip_prefix("http://").unwrap();
    let (status, said) = health(&[&format!("https://{address}"), "--ca", &cert]);
    assert_eq!(status, Some(1));
    assert!(said.contains(&format!("the server at {address} does not speak TLS: use http://{address}")), "{said}");
}

#[test]
fn an_address_that_is_in_use_is_told_with_what_to_do() {
    let taken = TestServer::start(&[]);
    let address = taken.url.strip_prefix("http://").unwrap();
    let ended = palpate(&["serve", "--listen", address]);
    let said = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("can't listen on {address}: another program")), "{said}");
    assert!(said.contains("give another --listen"), "{said}");
}
