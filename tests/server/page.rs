//! The page and gRPC-web on the port of gRPC, spoken to by hand over HTTP/1.1.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;

use crate::common::cores;
use crate::common::server::{TEST_TIMEOUT, TestServer, repository, told};
use palpate::server::identity::{self, Role};
use palpate_proto::pb;
use palpate_session::wire;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::collection::find_script;
use prost::Message;

/// Head, in small letters, and body of an answer.
fn ask(server: &TestServer, method: &str, path: &str, headers: &str, body: &[u8]) -> (String, Vec<u8>) {
    let address = server.url.trim_start_matches("http://");
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n"
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(body).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
    (String::from_utf8(answer[..end].to_vec()).unwrap().to_lowercase(), answer[end + 4..].to_vec())
}

fn get(server: &TestServer, path: &str, headers: &str) -> (String, String) {
    let (head, body) = ask(server, "GET", path, headers, b"");
    (head, String::from_utf8_lossy(&body).into_owned())
}

/// A server whose page is a folder of our own.
fn with_page() -> (TestServer, tempfile::TempDir) {
    with_page_and(|_| Vec::new())
}

/// Starts a server with options that may name files of the folder.
fn with_page_and(options: impl Fn(&Path) -> Vec<String>) -> (TestServer, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("secret.txt"), "not for you").unwrap();
    let page = folder.path().join("page");
    std::fs::create_dir_all(page.join("assets")).unwrap();
    std::fs::write(page.join("index.html"), "<title>tissue</title>").unwrap();
    std::fs::write(page.join("assets/index-1a2b.js"), "export {}").unwrap();
    let options = [vec!["--viewer".to_owned(), page.to_str().unwrap().to_owned()], options(folder.path())].concat();
    let options: Vec<&str> = options.iter().map(String::as_str).collect();
    (TestServer::start(&options), folder)
}

#[test]
fn a_page_has_its_type_its_policy_and_a_tag() {
    let (server, _folder) = with_page();
    let (head, body) = get(&server, "/?session=1", "");
    assert!(head.starts_with("http/1.1 200") && body.contains("<title>tissue"), "{head}\n{body}");
    for line in [
        "content-type: text/html; charset=utf-8",
        "cache-control: no-cache",
        "content-security-policy: default-src 'none'",
    ] {
        assert!(head.contains(line), "{head}");
    }
    let (head, _) = get(&server, "/assets/index-1a2b.js", "");
    assert!(head.contains("content-type: text/javascript") && head.contains("immutable"), "{head}");
    let tag = head.lines().find_map(|line| line.strip_prefix("etag: ")).unwrap().to_owned();
    let (head, body) = get(&server, "/assets/index-1a2b.js", &format!("If-None-Match: {tag}\r\n"));
    assert!(head.starts_with("http/1.1 304") && body.is_empty(), "{head}");
}

/// A connection over which one file is asked for so many times at once.
fn pipelined(server: &TestServer, path: &str, times: usize) -> TcpStream {
    let address = server.url.trim_start_matches("http://");
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n");
    stream.write_all(request.repeat(times).as_bytes()).unwrap();
    stream
}

#[test]
fn pipelined_requests_are_answered_in_order_and_unread_answers_share_one_file() {
    let (server, folder) = with_page();
    const BYTES: usize = 16 << 20;
    let picture = (0..BYTES).map(|at| (at % 251) as u8).collect::<Vec<_>>();
    std::fs::write(folder.path().join("page/picture.bin"), &picture).unwrap();
    let before = cores::resident(server.child.id());
    let mut connections: Vec<_> = (0..24).map(|_| pipelined(&server, "/picture.bin", 8)).collect();
    // The first part of an answer has come to each, so that each has its file; no client reads on.
    for stream in &mut connections {
        stream.read_exact(&mut [0; 1 << 16]).unwrap();
    }
    let more = cores::resident(server.child.id()) - before;
    assert!(more < 96 << 20, "{more} bytes for unread answers of one file of {BYTES}");
    drop(connections);
    // A client that reads gets each whole answer.
    let mut stream = std::io::BufReader::new(pipelined(&server, "/picture.bin", 3));
    for _ in 0..3 {
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            head.push(byte[0]);
        }
        let head = String::from_utf8(head).unwrap().to_lowercase();
        assert!(head.starts_with("http/1.1 200") && head.contains(&format!("content-length: {BYTES}")), "{head}");
        let mut body = vec![0; BYTES];
        stream.read_exact(&mut body).unwrap();
        assert!(body == picture);
    }
}

#[test]
fn nothing_leads_out_of_the_pages_folder() {
    let (server, folder) = with_page();
    let secret = folder.path().join("secret.txt");
    for path in ["/../secret.txt", "/assets/../../secret.txt", "/%2e%2e/secret.txt", &format!("/{}", secret.display())]
    {
        let (head, body) = get(&server, path, "");
        assert!(head.starts_with("http/1.1 404") && !body.contains("not for you"), "{path}: {head}\n{body}");
    }
    let (head, _) = ask(&server, "POST", "/", "", b"x");
    assert!(head.starts_with("http/1.1 405") && head.contains("allow: get, head"), "{head}");
    // A scene's picture; a name without a picture is not an error.
    let (head, body) = get(&server, "/textures/paper.png", "");
    assert!(head.starts_with("http/1.1 200") && head.contains("image/png") && body.contains("IHDR"), "{head}");
    assert!(get(&server, "/textures/nowhere.png", "").0.starts_with("http/1.1 204"));
}

/// Only where the program has no page within.
#[cfg(not(feature = "viewer"))]
#[test]
fn without_a_page_it_says_how_to_get_one_and_serves_all_the_same() {
    let empty = tempfile::tempdir().unwrap();
    // A page that is gone once the server runs: without one, `--viewer` is refused.
    let index = empty.path().join("index.html");
    std::fs::write(&index, "<title>tissue</title>").unwrap();
    let server = TestServer::start(&["--viewer", empty.path().to_str().unwrap()]);
    std::fs::remove_file(index).unwrap();
    let (head, body) = get(&server, "/", "");
    assert!(head.starts_with("http/1.1 404") && head.contains("text/html"), "{head}");
    assert!(body.contains("make viewer") && body.contains("Node.js"), "{body}");
    assert!(body.contains(&empty.path().display().to_string()), "{body}");
    scenes_over_grpc_web(&server);
}

#[test]
fn grpc_web_is_answered_on_the_same_port() {
    let (server, _folder) = with_page();
    scenes_over_grpc_web(&server);
    // An unknown service is refused with a gRPC status.
    let (head, _) =
        ask(&server, "POST", "/palpate.v1.Nothing/Call", "Content-Type: application/grpc-web+proto\r\n", b"");
    assert!(head.contains("grpc-status: 12"), "{head}");
}

#[test]
fn a_page_is_for_everybody_and_its_calls_for_those_with_a_token() {
    let token = identity::new_token().unwrap();
    let (server, _folder) = with_page_and(|folder| {
        let tokens = folder.join("tokens.toml");
        std::fs::write(&tokens, identity::entry("screen", &[Role::Watch], &token).unwrap()).unwrap();
        vec!["--tokens".to_owned(), tokens.to_str().unwrap().to_owned()]
    });
    for path in ["/", "/?session=1", "/assets/index-1a2b.js", "/textures/paper.png"] {
        assert!(get(&server, path, "").0.starts_with("http/1.1 200"), "{path}");
    }
    let call = |method: &str, content_type: &str, authorization: &str| {
        let headers = format!("Content-Type: {content_type}\r\n{authorization}");
        ask(&server, "POST", &format!("/palpate.v1.SessionService/{method}"), &headers, &[0; 5]).0
    };
    let known = format!("Authorization: Bearer {token}\r\n");
    for content_type in ["application/grpc-web+proto", "application/grpc-web-text", "application/grpc", "text/html"] {
        for (method, authorization, status) in [
            ("ListScenes", "", 16),
            ("ListScenes", "Authorization: Bearer palpate_guess\r\n", 16),
            ("CreateSession", &known, 7),
            // A file that looks like a page is not served as one.
            ("ListScenes/index.html", "", 7),
        ] {
            let head = call(method, content_type, authorization);
            assert!(head.contains(&format!("grpc-status: {status}")), "{method} as {content_type}: {head}");
        }
    }
    // A page can't get around the question by asking for a call as for a file.
    let (head, _) = get(&server, "/palpate.v1.SessionService/ListScenes", "");
    assert!(head.contains("grpc-status: 16"), "{head}");
    scenes_over_grpc_web_as(&server, &known);
}

fn scenes_over_grpc_web(server: &TestServer) {
    scenes_over_grpc_web_as(server, "");
}

fn scenes_over_grpc_web_as(server: &TestServer, authorization: &str) {
    let headers = format!("Content-Type: application/grpc-web+proto\r\n{authorization}");
    let (head, body) = ask(server, "POST", "/palpate.v1.SessionService/ListScenes", &headers, &[0; 5]);
    assert!(head.starts_with("http/1.1 200") && head.contains("application/grpc-web+proto"), "{head}");
    let text = String::from_utf8_lossy(&body);
    assert!(text.contains("paper") && text.contains("grpc-status:0"), "{text}");
}

#[tokio::test]
async fn a_script_of_the_server_is_the_commands_that_a_replay_sends() {
    let server = TestServer::start(&[]);
    let session_id = server.paper(true).await;
    let mut sessions = server.sessions().await;
    let listed = sessions.list_scripts(pb::ListScriptsRequest::default()).await.unwrap().into_inner().script_names;
    assert_eq!(
        listed,
        [
            "cut",
            "cut-solid",
            "dissect",
            "grasp",
            "lift",
            "oblique-100",
            "oblique-60",
            "press",
            "push",
            "stroke",
            "suture",
            "vertical-60"
        ]
    );
    let limits = Limits::default();
    let scene = Scene::load(&repository().join("scenes/paper.toml"), &[], &limits).unwrap();
    // `lift` samples vertices, which a sheet has none of.
    for script_name in listed.into_iter().filter(|name| name != "lift") {
        let script = find_script(Path::new(&script_name), &scene, &limits).unwrap();
        let request = pb::GetScriptRequest { session_id: session_id.clone(), script_name };
        let mut parts = sessions.get_script(request).await.unwrap().into_inner();
        let mut commands = Vec::new();
        let mut is_over = false;
        while let Some(part) = parts.message().await.unwrap() {
            assert!(!is_over);
            assert_eq!((part.steps, part.tools as usize), (script.steps, script.tools()));
            is_over = part.last;
            commands.extend(part.commands);
        }
        assert!(is_over);
        let wanted: Vec<_> = (0..script.steps)
            .flat_map(|step| script.actions_at(step).map(move |(tool, action)| (tool, step, action)))
            .map(|(tool, step, action)| wire::command::scripted(&*script.shape, tool, step, &action, 0))
            .collect();
        assert!(commands.len() > 1 && commands == wanted);
        assert!(commands.iter().all(|command| command.encoded_len() < 200));
    }
    let request = pb::GetScriptRequest { session_id, script_name: "../paper".into() };
    let refused = sessions.get_script(request).await.unwrap_err();
    assert_eq!(told(&refused).1, "UNKNOWN_SCRIPT");
}

/// Takes a tool by a call over HTTP/1.1; how long it is held without a command, s.
fn acquire(server: &TestServer, session_id: &str, tool: u32, outlives_connection: bool) -> f64 {
    let lease_s = Some(600.0);
    let request = pb::AcquireToolRequest {
        session_id: session_id.to_owned(),
        tool,
        lease_s,
        outlives_connection,
        ..Default::default()
    };
    let message = request.encode_to_vec();
    let frame = [&[0][..], &u32::try_from(message.len()).unwrap().to_be_bytes(), &message].concat();
    let headers = "Content-Type: application/grpc-web+proto\r\n";
    let (head, body) = ask(server, "POST", "/palpate.v1.HapticService/AcquireTool", headers, &frame);
    assert!(head.starts_with("http/1.1 200"), "{head}");
    // The frame of the answer, wherever the transfer coding has put it.
    let answers = (0..body.len().saturating_sub(5)).filter_map(|at| {
        let length = u32::from_be_bytes(body[at + 1..at + 5].try_into().unwrap()) as usize;
        pb::AcquireToolResponse::decode(body.get(at + 5..)?.get(..length)?).ok().filter(|_| body[at] == 0)
    });
    let told = answers.into_iter().find(|answer| answer.lease_id.len() == 32);
    told.unwrap_or_else(|| panic!("{head}\n{}", String::from_utf8_lossy(&body))).lease_s
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tool_taken_over_grpc_web_is_not_held_for_long_by_who_says_nothing() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    assert_eq!(acquire(&server, &session, 0, false), 10.0);
    assert_eq!(acquire(&server, &session, 1, true), 600.0);
    assert_eq!(server.status(&session).await.held_tools.len(), 2);
    // The same with a shorter time, to see it pass.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nbrowser_lease_s = 0.2\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let session = server.paper(false).await;
    assert_eq!(acquire(&server, &session, 0, false), 0.2);
    assert_eq!(acquire(&server, &session, 1, true), 600.0);
    let expired = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            let status = server.status(&session).await;
            if status.lapsed_leases == 1 {
                break status.held_tools;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    });
    let held: Vec<u32> = expired.await.expect("the lease did not expire").iter().map(|held| held.tool).collect();
    assert_eq!(held, [1]);
}
