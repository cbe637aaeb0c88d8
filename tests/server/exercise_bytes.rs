//! Nothing that a trainee's client receives has the truth of the exercise in it: the messages of each call that may show a
//! tissue are looked through, as bytes.

use std::collections::BTreeMap;

use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::exercise_service_client::ExerciseServiceClient;
use pb::touch_request::Message as Say;
use prost::Message;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::client::Grpc;
use tonic::transport::Channel;
use tonic::{Request, Status, Streaming};

use crate::common::raw_codec::RawBytes;
use crate::common::server::{TEST_TIMEOUT, TestServer};

/// What a trainee's client received, by call.
type Received = BTreeMap<&'static str, Vec<Vec<u8>>>;

/// A trainee's client, which keeps every byte.
struct Trainee<'s> {
    server: &'s TestServer,
    id: String,
    received: Received,
}

/// An error with all that it carries.
fn error_bytes(status: &Status) -> Vec<u8> {
    [status.message().as_bytes(), status.details()].concat()
}

impl Trainee<'_> {
    async fn client(&self) -> Grpc<Channel> {
        let mut client = Grpc::new(self.server.channel().await);
        client.ready().await.unwrap();
        client
    }

    fn keep(&mut self, path: &'static str, message: Vec<u8>) {
        self.received.entry(path).or_default().push(message);
    }

    async fn unary(&mut self, path: &'static str, request: impl Message) -> Option<Vec<u8>> {
        let (mut client, uri) = (self.client().await, http::uri::PathAndQuery::from_static(path));
        let answer = client.unary(Request::new(request.encode_to_vec()), uri, RawBytes).await;
        let answer = answer.map(tonic::Response::into_inner);
        self.keep(path, answer.as_ref().map_or_else(error_bytes, Clone::clone));
        answer.ok()
    }

    /// Reads a stream to its end, or `most` messages of it.
    async fn stream(&mut self, path: &'static str, request: impl Message, most: usize) {
        let (mut client, uri) = (self.client().await, http::uri::PathAndQuery::from_static(path));
        let answer = client.server_streaming(Request::new(request.encode_to_vec()), uri, RawBytes).await;
        let mut messages = match answer {
            Ok(answer) => answer.into_inner(),
            Err(status) => return self.keep(path, error_bytes(&status)),
        };
        for _ in 0..most {
            let message = tokio::time::timeout(TEST_TIMEOUT, messages.message()).await.expect(path);
            match message {
                Ok(Some(message)) => self.keep(path, message),
                Ok(None) => break,
                Err(status) => return self.keep(path, error_bytes(&status)),
            }
        }
    }

    /// Opens a haptic stream with a device, and reads it until it has a sample and the exact force law.
    async fn touch(&mut self) -> (mpsc::Sender<Vec<u8>>, Streaming<Vec<u8>>) {
        let device = pb::Device {
            name: "test".into(),
            max_force_n: 10.0,
            continuous_force_n: 5.0,
            max_stiffness_n_per_m: 3000.0,
            max_damping_n_s_per_m: 10.0,
            workspace_radius_m: 0.2,
            max_torque_n_m: 0.0,
        };
        let tip = Some(pb::Tip { radius_m: 0.008, ..Default::default() });
        let session_id = self.id.clone();
        let (device, lease_s, touch_stiffness) = (Some(device), Some(60.0), true);
        let open =
            pb::TouchOpen { session_id, tools: vec![0], lease_s, device, tip, touch_stiffness, ..Default::default() };
        let (send, messages) = mpsc::channel(256);
        send.send(pb::TouchRequest { message: Some(Say::Open(open)) }.encode_to_vec()).await.unwrap();
        let path = "/palpate.v1.HapticService/Touch";
        let uri = http::uri::PathAndQuery::from_static(path);
        let mut client = self.client().await;
        let answer = client.streaming(Request::new(ReceiverStream::new(messages)), uri, RawBytes).await;
        let mut inbound = answer.unwrap().into_inner();
        let (mut sampled, mut is_exact) = (false, false);
        while !sampled || !is_exact {
            use pb::touch_response::Message as Heard;
            let message = tokio::time::timeout(TEST_TIMEOUT, inbound.message()).await.unwrap().unwrap().unwrap();
            match pb::TouchResponse::decode(&*message).unwrap().message.unwrap() {
                Heard::Opened(opened) => is_exact = !opened.law.unwrap().coarse,
                Heard::Sample(_) => sampled = true,
                Heard::ForceLaw(_) => is_exact = true,
                other => panic!("{other:?}"),
            }
            self.keep(path, message);
        }
        (send, inbound)
    }

    /// Makes every call that has to do with a session, before anything is touched.
    async fn ask_everything(&mut self) {
        let id = || self.id.clone();
        let (session_id, by_id) = (self.id.clone(), pb::GetSessionRequest { session_id: id() });
        self.unary("/palpate.v1.SessionService/GetSession", by_id).await.unwrap();
        self.unary("/palpate.v1.SessionService/ListSessions", pb::ListSessionsRequest {}).await;
        self.unary("/palpate.v1.SessionService/ListScenes", pb::ListScenesRequest {}).await;
        self.unary("/palpate.v1.SessionService/ListScripts", pb::ListScriptsRequest { session_id: session_id.clone() })
            .await;
        self.unary("/palpate.v1.ExerciseService/ListExercises", pb::ListExercisesRequest {}).await;
        let session = || session_id.clone();
        self.unary(
            "/palpate.v1.SessionService/GetStateHash",
            pb::GetStateHashRequest { session_id: session(), at_step: None },
        )
        .await;
        let curves = pb::CompareCurvesRequest {
            session_id: session(),
            table: "time_s,depth_m,force_n\n0,0,0\n0.1,0.001,1\n".to_owned(),
            ..Default::default()
        };
        self.unary("/palpate.v1.SessionService/CompareCurves", curves).await;
        self.unary("/palpate.v1.SessionService/GetJournal", pb::GetJournalRequest { session_id: session(), run: 0 })
            .await;
        self.unary("/palpate.v1.SessionService/ListJournals", pb::ListJournalsRequest {}).await;
        self.unary("/palpate.v1.SessionService/PauseSession", pb::PauseSessionRequest { session_id: session() }).await;
        let change =
            pb::UpdateTissueRequest { session_id: session(), stiffness_n_per_m: Some(1.0), ..Default::default() };
        self.unary("/palpate.v1.SessionService/UpdateTissue", change).await;
        self.unary("/palpate.v1.AdminService/ListStreams", pb::ListStreamsRequest { session_id: session() }).await;
        self.unary("/palpate.v1.AdminService/ListCallers", pb::ListCallersRequest {}).await;
        self.stream("/palpate.v1.SessionService/SaveSnapshot", pb::SaveSnapshotRequest { session_id: session() }, 1000)
            .await;
        let script = pb::GetScriptRequest { session_id: session(), script_name: "press".into() };
        self.stream("/palpate.v1.SessionService/GetScript", script, 1000).await;
        let probe = pb::ProbeRequest {
            session_id: session(),
            r#where: Some(pb::probe_request::Where::AllPoints(true)),
            energy: true,
            ..Default::default()
        };
        self.stream("/palpate.v1.HapticService/Probe", probe, 1).await;
        let watch = pb::WatchSamplesRequest { session_id: session(), ..Default::default() };
        self.stream("/palpate.v1.HapticService/WatchSamples", watch, 1).await;
        self.stream(
            "/palpate.v1.ViewService/GetMesh",
            pb::GetMeshRequest { session_id: session(), refinement: 0 },
            1000,
        )
        .await;
        let texture = pb::GetTextureRequest { session_id: session(), ..Default::default() };
        self.stream("/palpate.v1.ViewService/GetTexture", texture, 1000).await;
        let topology = pb::GetTopologyRequest { session_id: session(), since_version: 0, by_name: false };
        self.stream("/palpate.v1.ViewService/GetTopology", topology, 1000).await;
        let wound = pb::GetWoundRequest { session_id: session(), ..Default::default() };
        self.stream("/palpate.v1.ViewService/GetWound", wound, 1000).await;
        let burns = pb::GetBurnsRequest { session_id: session(), ..Default::default() };
        self.stream("/palpate.v1.ViewService/GetBurns", burns, 1000).await;
        let frames =
            pb::WatchFramesRequest { session_id: session(), encoding: pb::Encoding::F32.into(), ..Default::default() };
        self.stream("/palpate.v1.ViewService/WatchFrames", frames, 1).await;
        let exercise = pb::WatchExerciseRequest { session_id: session() };
        self.stream("/palpate.v1.ExerciseService/WatchExercise", exercise, 1).await;
    }
}

async fn exercises(server: &TestServer) -> ExerciseServiceClient<Channel> {
    ExerciseServiceClient::new(server.channel().await)
}

/// A message without what differs between any two sessions: IDs, times of clocks, processor time and memory.
fn without_ids(path: &str, message: &[u8], ids: &[&str]) -> Vec<u8> {
    let mut message = message.to_vec();
    if path.ends_with("/Touch") {
        use pb::touch_response::Message as Heard;
        let mut response = pb::TouchResponse::decode(&*message).unwrap();
        match response.message.as_mut().unwrap() {
            Heard::Opened(opened) => opened.lease_id.clear(),
            Heard::Sample(sample) => sample.server_time_ns = 0,
            _ => {}
        }
        message = response.encode_to_vec();
    } else if path.ends_with("/WatchSamples") {
        let mut response = pb::WatchSamplesResponse::decode(&*message).unwrap();
        response.sample.as_mut().unwrap().server_time_ns = 0;
        message = response.encode_to_vec();
    } else if path.ends_with("/WatchFrames") {
        let mut response = pb::WatchFramesResponse::decode(&*message).unwrap();
        response.viewer_id.clear();
        message = response.encode_to_vec();
    } else if path.ends_with("/ListCallers") {
        message.clear();
    }
    for id in ids {
        while let Some(at) = message.windows(id.len()).position(|window| window == id.as_bytes()) {
            message[at..at + id.len()].fill(b'-');
        }
    }
    message
}

fn has(messages: &Received, secret: &[u8]) -> Option<&'static str> {
    let found =
        |messages: &Vec<Vec<u8>>| messages.iter().any(|m| m.windows(secret.len()).any(|window| window == secret));
    messages.iter().find(|(_, messages)| found(messages)).map(|(path, _)| *path)
}

/// Each secret of a session as it could be written: numbers as f64, places also as f32, and as decimal text.
fn secrets(session: &pb::Session) -> Vec<Vec<u8>> {
    let exercise = session.exercise.as_ref().unwrap();
    let mut secrets = vec![session.session_id.clone().into_bytes(), exercise.seed.unwrap().to_string().into_bytes()];
    for inclusion in &session.scene.as_ref().unwrap().inclusions {
        let place_m = inclusion.centre_m.unwrap();
        let numbers =
            [place_m.x, place_m.y, place_m.z, inclusion.radius_m.unwrap(), inclusion.stiffness_factor.unwrap()];
        for number in numbers {
            secrets.push(number.to_le_bytes().to_vec());
            let text = number.to_string();
            // Six digits are enough to know it again.
            secrets.push(text.as_bytes()[..text.len().min(9)].to_vec());
        }
        for pair in [[place_m.x, place_m.y], [place_m.y, place_m.z]] {
            #[allow(clippy::cast_possible_truncation)]
            secrets.push(pair.map(|number| (number as f32).to_le_bytes()).concat());
        }
    }
    secrets
}

#[tokio::test]
async fn what_a_trainee_receives_is_equal_for_two_truths_before_the_first_touch_and_never_has_a_lump_in_it() {
    let mut of_truths = Vec::new();
    for seed in [9_007_199_254_740_881, 9_007_199_254_740_847] {
        let folder = tempfile::tempdir().unwrap();
        let server = TestServer::start_patiently(folder.path(), "", "");
        let source = Some(pb::chosen_exercise::Source::Name("lumps-1".to_owned()));
        let chosen = pb::ChosenExercise { source, seed: Some(seed), scene_name: String::new() };
        let mut session = server.create(Source::Exercise(chosen), true).await.unwrap();
        let id = session.exercise.as_ref().unwrap().trainee_id.clone();
        let mut trainee = Trainee { server: &server, id: id.clone(), received: Received::new() };
        trainee.ask_everything().await;
        let (send, mut inbound) = trainee.touch().await;
        let before: Received = trainee.received.clone();
        // Its trainer hides another lump.
        let another = pb::HideLumpRequest { session_id: session.session_id.clone(), lump: None };
        let another = exercises(&server).await.hide_lump(another).await.unwrap().into_inner().lump.unwrap();
        session.scene.as_mut().unwrap().inclusions.push(pb::Inclusion {
            centre_m: another.centre_m,
            radius_m: Some(another.radius_m),
            stiffness_factor: Some(another.stiffness_factor),
            ..Default::default()
        });
        // It touches: what it feels depends on the truth, and does not tell it.
        server.start_until(&id, 700).await;
        for number in 0..40_u32 {
            let position_m = Some(pb::Vector3 { x: 0.01, y: 0.0, z: 0.043 - 0.0002 * f64::from(number) });
            let tip = Some(pb::Tip { radius_m: 0.008, ..Default::default() });
            let action = Some(pb::command::Action::Pose(pb::Pose { position_m, tip, ..Default::default() }));
            let (sequence, at_step) = (Some(u64::from(number) + 1), Some(10 + 10 * u64::from(number)));
            let command = pb::Command { sequence, at_step, action, ..Default::default() };
            send.send(pb::TouchRequest { message: Some(Say::Command(command)) }.encode_to_vec()).await.unwrap();
        }
        let mut newest = 0;
        while newest < 700 {
            let message = tokio::time::timeout(TEST_TIMEOUT, inbound.message()).await.unwrap().unwrap().unwrap();
            let heard = pb::TouchResponse::decode(&*message).unwrap().message;
            if let Some(pb::touch_response::Message::Sample(sample)) = heard {
                newest = sample.step;
            }
            trainee.keep("/palpate.v1.HapticService/Touch", message);
        }
        trainee.ask_everything().await;
        assert!(trainee.received.values().flatten().count() > 100, "{}", trainee.received.len());
        // The search finds what is there: the trainer is told all of it.
        let told = Received::from([("", vec![session.encode_to_vec()])]);
        let lump = session.scene.as_ref().unwrap().inclusions[0].centre_m.unwrap();
        assert!(has(&told, &lump.x.to_le_bytes()).is_some() && has(&told, session.session_id.as_bytes()).is_some());
        for secret in secrets(&session) {
            let found = has(&trainee.received, &secret);
            assert_eq!(found, None, "{secret:02x?}, {}", String::from_utf8_lossy(&secret));
        }
        of_truths.push((before, id, session));
    }
    let [(one, one_id, session), (other, other_id, other_session)] = &of_truths[..] else { panic!("two truths") };
    assert_ne!(session.scene.as_ref().unwrap().inclusions, other_session.scene.as_ref().unwrap().inclusions);
    assert_eq!(one.keys().collect::<Vec<_>>(), other.keys().collect::<Vec<_>>());
    for (path, messages) in one {
        let bare = |messages: &[Vec<u8>], id: &str| -> Vec<Vec<u8>> {
            let mut bare: Vec<_> = messages.iter().map(|message| without_ids(path, message, &[id])).collect();
            // Which of a sample and a law comes first is a matter of time.
            bare.sort();
            bare
        };
        let [one, other] = [bare(messages, one_id), bare(&other[path], other_id)];
        assert!(one == other, "{path} differs: {one:02x?} {other:02x?}");
    }
}
