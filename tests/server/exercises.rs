//! Sessions that are made for an exercise: what a trainer and a trainee are told, and that it is what the journal gives.

use std::collections::BTreeSet;
use std::path::Path;

use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::exercise_service_client::ExerciseServiceClient;
use serde_json::Value;
use tonic::Code;
use tonic::transport::Channel;

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, open, palpate, told};

async fn exercises(server: &TestServer) -> ExerciseServiceClient<Channel> {
    ExerciseServiceClient::new(server.channel().await)
}

fn lumps(seed: Option<u64>) -> Source {
    let source = Some(pb::chosen_exercise::Source::Name("lumps-1".to_owned()));
    Source::Exercise(pb::ChosenExercise { source, seed, scene_name: String::new() })
}

/// A session of `lumps-1`, with the ID that opens it for a trainee.
async fn created(server: &TestServer, seed: Option<u64>) -> (pb::Session, String) {
    let session = server.create(lumps(seed), false).await.unwrap();
    let trainee_id = session.exercise.clone().unwrap().trainee_id;
    (session, trainee_id)
}

fn pose(sequence: u64, place_m: [f64; 3]) -> pb::Command {
    let [x, y, z] = place_m;
    let tip = Some(pb::Tip { radius_m: 0.008, ..Default::default() });
    let pose = pb::Pose { position_m: Some(pb::Vector3 { x, y, z }), tip, ..Default::default() };
    let action = Some(pb::command::Action::Pose(pose));
    pb::Command { tool: 0, sequence: Some(sequence), action, ..Default::default() }
}

fn mark(sequence: u64, [x, y, z]: [f64; 3]) -> pb::Command {
    let mark = pb::Mark { place_m: Some(pb::Vector3 { x, y, z }), diameter_m: None };
    let action = Some(pb::command::Action::Mark(mark));
    pb::Command { tool: 0, sequence: Some(sequence), action, ..Default::default() }
}

/// Presses the block near its middle, marks it, lets go, and waits until the tissue has rested for a while. The steps are given, so that
/// the network has no effect on what is done.
async fn press_and_mark(server: &TestServer, session_id: &str) {
    let mut touch = TestTouch::hold(server, session_id).await;
    let from = touch.opened.as_ref().unwrap().step + 500;
    let mut commands: Vec<pb::Command> = Vec::new();
    for depth_mm in (0..24).chain((0..24).rev()) {
        commands.push(pose(0, [0.01, 0.0, 0.044 - 0.0004 * f64::from(depth_mm)]));
    }
    commands.push(mark(0, [0.01, 0.0, 0.04]));
    let release = Some(pb::command::Action::Release(pb::Release {}));
    commands.push(pb::Command { action: release, ..Default::default() });
    for (number, command) in (1..).zip(commands) {
        let (sequence, at_step) = (Some(number), Some(from + 8 * number));
        touch.command(pb::Command { sequence, at_step, ..command }).await;
    }
    touch.settle().await;
    touch.sample_with(|sample| sample.step > from + 1000).await;
}

type Watched = tonic::Streaming<pb::WatchExerciseResponse>;

async fn watch(server: &TestServer, session_id: &str) -> Watched {
    let request = pb::WatchExerciseRequest { session_id: session_id.to_owned() };
    exercises(server).await.watch_exercise(request).await.unwrap().into_inner()
}

/// All messages to the end of a stream.
async fn all(mut watched: Watched) -> Vec<pb::WatchExerciseResponse> {
    let mut messages = Vec::new();
    while let Some(message) = tokio::time::timeout(TEST_TIMEOUT, watched.message()).await.unwrap().unwrap() {
        messages.push(message);
    }
    messages
}

async fn finish(server: &TestServer, session_id: &str) -> pb::ExerciseResult {
    end(server, session_id, 0).await.unwrap().unwrap()
}

/// Ends a phase, or the whole exercise (0).
async fn end(server: &TestServer, session_id: &str, phase: u32) -> Result<Option<pb::ExerciseResult>, tonic::Status> {
    let request = pb::FinishExerciseRequest { session_id: session_id.to_owned(), phase };
    exercises(server).await.finish_exercise(request).await.map(|finished| finished.into_inner().result)
}

async fn hide(
    server: &TestServer,
    session_id: &str,
    lump: Option<pb::HiddenLump>,
) -> Result<pb::HideLumpResponse, tonic::Status> {
    let request = pb::HideLumpRequest { session_id: session_id.to_owned(), lump };
    exercises(server).await.hide_lump(request).await.map(tonic::Response::into_inner)
}

/// The figures by name and tool, as bits.
fn bits(figures: &[pb::Figure]) -> BTreeSet<(String, Option<u32>, u64)> {
    figures.iter().map(|figure| (figure.measure.clone(), figure.tool, figure.value.to_bits())).collect()
}

/// The score of a journal as text and as JSON, whose numbers may differ in their last bit from those of the text.
fn score(journal: &Path, arguments: &[&str]) -> Result<(String, Value), String> {
    let mut all = vec!["journal", "score", journal.to_str().unwrap(), "--json", "--quiet"];
    all.extend(arguments);
    let output = palpate(&all);
    if !output.status.success() {
        return Err(String::from_utf8(output.stderr).unwrap());
    }
    let text = String::from_utf8(output.stdout).unwrap();
    let json = serde_json::from_str(&text).unwrap();
    Ok((text, json))
}

/// The figures of a score, by name and tool.
fn scored((text, json): &(String, Value)) -> BTreeSet<(String, Option<u32>, u64)> {
    let of_measures = text.split("\"measures\": [").nth(1).unwrap().split(']').next().unwrap();
    let values = of_measures.split("\"value\": ").skip(1).map(|rest| rest.split([',', '\n']).next().unwrap());
    let names = json["measures"].as_array().unwrap().iter().map(|figure| {
        let tool = figure["tool"].as_u64().map(|tool| u32::try_from(tool).unwrap());
        (figure["name"].as_str().unwrap().to_owned(), tool)
    });
    names.zip(values).map(|((name, tool), value)| (name, tool, value.parse::<f64>().unwrap().to_bits())).collect()
}

#[tokio::test]
async fn live_figures_the_result_and_the_journal_have_equal_bits_and_a_trainee_is_told_what_it_may_know() {
    let folder = tempfile::tempdir().unwrap();
    let journals = folder.path().join("journals");
    let server = TestServer::start_patiently(folder.path(), &format!("journal = {journals:?}"), "");
    let (session, trainee_id) = created(&server, Some(7)).await;
    let (by_trainer, by_trainee) = (watch(&server, &session.session_id).await, watch(&server, &trainee_id).await);
    let [by_trainer, by_trainee] = [by_trainer, by_trainee].map(|watched| tokio::spawn(all(watched)));
    press_and_mark(&server, &trainee_id).await;
    let result = finish(&server, &trainee_id).await;
    // What is done later does not count.
    press_and_mark(&server, &trainee_id).await;
    assert_eq!(finish(&server, &session.session_id).await, result);
    let (by_trainer, by_trainee) = (by_trainer.await.unwrap(), by_trainee.await.unwrap());
    let last = by_trainer.last().unwrap();
    assert_eq!(last.result.as_ref(), Some(&result));
    assert_eq!((last.step, bits(&last.figures)), (result.step, bits(&result.figures)));
    assert!(result.is_told && result.score_percent.is_some() && !result.lumps.is_empty());
    assert_eq!(result.answers.len(), 1);
    let value = |name: &str| {
        result.figures.iter().find(|figure| figure.measure == name && figure.tool.is_none()).unwrap().value
    };
    assert!(value("peak_force_n") > 0.1 && value("press_count") >= 1.0 && value("coverage_share") > 0.0, "{result:?}");
    // Ten per second of simulated time at most: a slow reader gets the newest.
    let steps: Vec<u64> = by_trainer.iter().map(|message| message.step).collect();
    assert!(steps.len() > 2 && steps.is_sorted(), "{steps:?}");
    let named = |message: &pb::WatchExerciseResponse| -> BTreeSet<String> {
        message.figures.iter().map(|figure| figure.measure.clone()).collect()
    };
    assert!(named(last).contains("hits_share"));
    for message in &by_trainee {
        assert!(message.score_percent.is_none() && !named(message).contains("hits_share"), "{message:?}");
    }
    assert_eq!(by_trainee.last().unwrap().result.as_ref(), Some(&result));
    // The journal has the exercise, the seed and the end.
    let delete = pb::DeleteSessionRequest { session_id: session.session_id.clone() };
    let mut sessions = server.sessions().await;
    assert_eq!(
        told(&sessions.delete_session(pb::DeleteSessionRequest { session_id: trainee_id }).await.unwrap_err()).1,
        "NOT_FOR_TRAINEE"
    );
    sessions.delete_session(delete).await.unwrap();
    let journal = journals.join(format!("{}.1.mcap", session.session_id));
    let replayed = score(&journal, &[]).unwrap();
    assert_eq!(scored(&replayed), bits(&result.figures));
    let (_, json) = &replayed;
    assert!((json["exercise"]["score_percent"].as_f64().unwrap() - result.score_percent.unwrap()).abs() < 1e-9);
    assert_eq!((json["exercise"]["name"].as_str(), json["exercise"]["seed"].as_u64()), (Some("lumps-1"), Some(7)));
    assert_eq!(score(&journal, &["--exercise", "lumps-1", "--seed", "7"]).unwrap(), replayed);
    for (other, named) in [
        (&["--exercise", "lumps-2"][..], "--exercise: lumps-2: the session was made for the exercise `lumps-1`"),
        (&["--exercise", "lumps-1", "--seed", "8"], "--seed: 8: the session was made for the seed 7"),
    ] {
        let refused = score(&journal, other).unwrap_err();
        assert!(refused.contains(named), "{refused}");
    }
}

#[tokio::test]
async fn a_trainee_gets_no_call_that_shows_the_truth_and_a_trainer_advises() {
    let folder = tempfile::tempdir().unwrap();
    let server = TestServer::start_patiently(folder.path(), "", "");
    let (session, trainee_id) = created(&server, None).await;
    let exercise = session.exercise.clone().unwrap();
    assert!(exercise.seed.is_some_and(|seed| seed < 1 << 53) && exercise.role() == pb::ExerciseRole::Trainer);
    assert!(!session.scene.unwrap().inclusions.is_empty());
    let seen = server.status(&trainee_id).await;
    assert_eq!(seen.session_id, trainee_id);
    let told_to_trainee = seen.exercise.unwrap();
    assert_eq!((told_to_trainee.seed, told_to_trainee.trainee_id.as_str()), (None, ""));
    assert_eq!(told_to_trainee.role(), pb::ExerciseRole::Trainee);
    assert!(seen.scene.unwrap().inclusions.is_empty() && seen.audit.is_none() && seen.mesh_error_estimate.is_none());
    // Who may list without authentication does not learn the session's own ID.
    let listed = server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
    assert_eq!(listed.iter().map(|session| &session.session_id).collect::<Vec<_>>(), [&trainee_id]);
    let (mut sessions, mut haptics) = (server.sessions().await, server.haptics().await);
    let id = || trainee_id.clone();
    let journal = pb::JournalMoment { session_id: id(), ..Default::default() };
    let refused = [
        sessions.save_snapshot(pb::SaveSnapshotRequest { session_id: id() }).await.err(),
        sessions.get_state_hash(pb::GetStateHashRequest { session_id: id(), at_step: None }).await.err(),
        sessions.compare_curves(pb::CompareCurvesRequest { session_id: id(), ..Default::default() }).await.err(),
        sessions.get_script(pb::GetScriptRequest { session_id: id(), script_name: "press".into() }).await.err(),
        sessions.get_journal(pb::GetJournalRequest { session_id: id(), run: 0 }).await.err(),
        sessions.delete_journal(pb::DeleteJournalRequest { session_id: id() }).await.err(),
        sessions.pause_session(pb::PauseSessionRequest { session_id: id() }).await.err(),
        sessions.update_tissue(pb::UpdateTissueRequest { session_id: id(), ..Default::default() }).await.err(),
        haptics.probe(pb::ProbeRequest { session_id: id(), ..Default::default() }).await.err(),
        server
            .views()
            .await
            .get_topology(pb::GetTopologyRequest { session_id: id(), by_name: true, ..Default::default() })
            .await
            .err(),
        server.create(Source::Journal(journal), false).await.err(),
        exercises(&server)
            .await
            .advise_trainee(pb::AdviseTraineeRequest { session_id: id(), text: "a".into(), place_m: None })
            .await
            .err(),
        hide(&server, &trainee_id, None).await.err(),
    ];
    for refused in refused {
        let (code, reason, field) = told(&refused.unwrap());
        assert_eq!((code, reason.as_str(), field.as_str()), (Code::PermissionDenied, "NOT_FOR_TRAINEE", "session_id"));
    }
    let mut watched = watch(&server, &trainee_id).await;
    let advise = |text: &str, place_m: Option<[f64; 3]>| {
        let place_m = place_m.map(|[x, y, z]| pb::Vector3 { x, y, z });
        let request =
            pb::AdviseTraineeRequest { session_id: session.session_id.clone(), text: text.to_owned(), place_m };
        let server = &server;
        async move { exercises(server).await.advise_trainee(request).await }
    };
    advise("press deeper", None).await.unwrap();
    advise("", Some([0.01, 0.02, 0.04])).await.unwrap();
    let mut heard: Vec<pb::Advice> = Vec::new();
    let both = async {
        while heard.len() < 2 {
            heard.extend(watched.message().await.unwrap().unwrap().advice);
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, both).await.expect("advice is not heard");
    assert_eq!((heard[0].text.as_str(), heard[0].place_m, heard[0].number), ("press deeper", None, 1));
    assert_eq!(
        (heard[1].text.as_str(), heard[1].place_m, heard[1].number),
        ("", Some(pb::Vector3 { x: 0.01, y: 0.02, z: 0.04 }), 2)
    );
    for (text, place_m, reason, field) in [
        ("", None, "MISSING", "text"),
        ("a\nb", None, "WRONG_KIND", "text"),
        ("", Some([3.0, 0.0, 0.0]), "OFF_TISSUE", "place_m"),
        (&*"a".repeat(501), None, "TOO_LARGE", "text"),
    ] {
        let (_, told_reason, told_field) = told(&advise(text, place_m).await.unwrap_err());
        assert_eq!((told_reason.as_str(), told_field.as_str()), (reason, field));
    }
    for _ in 2..64 {
        advise("again", None).await.unwrap();
    }
    assert_eq!(told(&advise("again", None).await.unwrap_err()).1, "TOO_MANY");
    let mut open = open(&session.session_id, &[]);
    open.session_id = "0".repeat(32);
    assert_eq!(told(&TestTouch::open(&server, open).await.err().unwrap()).1, "UNKNOWN_SESSION");
}

#[tokio::test]
async fn an_exercise_of_a_client_is_read_and_what_is_wrong_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let server = TestServer::start_patiently(folder.path(), "", "");
    let text = |more: &str| {
        let text = format!(
            "name = \"mine\"\ninstructions = \"Press.\"\nscenes = [\"phantom\"]\ntime_limit_s = 0.3\n{more}\n\
             [[criterion]]\nmeasure = \"coverage_share\"\npoor = 0.0\ngood = 1.0\n[trainee]\nsees_result = false\n\
             live_measures = [\"coverage_share\"]\n"
        );
        let source = Some(pb::chosen_exercise::Source::Text(text));
        Source::Exercise(pb::ChosenExercise { source, ..Default::default() })
    };
    let session = server.create(text(""), false).await.unwrap();
    let trainee_id = session.exercise.unwrap().trainee_id;
    // It hides nothing, so that its trainee may have the whole tissue.
    server.sessions().await.save_snapshot(pb::SaveSnapshotRequest { session_id: trainee_id.clone() }).await.unwrap();
    // Its time ends it, at the step of its limit, although nobody does anything.
    let messages = all(watch(&server, &trainee_id).await).await;
    let result = messages.last().unwrap().result.clone().unwrap();
    assert_eq!((result.step, result.is_told, result.figures.len()), (300, false, 0));
    assert!(messages.iter().flat_map(|message| &message.figures).all(|figure| figure.measure == "coverage_share"));
    let by_trainer = finish(&server, &session.session_id).await;
    assert!(by_trainer.is_told && by_trainer.step == 300 && by_trainer.score_percent == Some(0.0));
    for (more, reason, field) in [
        ("set = [\"solid.cell_m=0.01\"]", "WRONG_KIND", "exercise.set"),
        ("colour = 1", "UNKNOWN_KEY", "exercise.colour"),
    ] {
        let (_, told_reason, told_field) = told(&server.create(text(more), false).await.unwrap_err());
        assert_eq!((told_reason.as_str(), told_field.as_str()), (reason, field));
    }
    let unknown = Some(pb::chosen_exercise::Source::Name("lumps-9".to_owned()));
    let unknown = Source::Exercise(pb::ChosenExercise { source: unknown, ..Default::default() });
    assert_eq!(told(&server.create(unknown, false).await.unwrap_err()).1, "UNKNOWN_EXERCISE");
    let listed = exercises(&server).await.list_exercises(pb::ListExercisesRequest {}).await.unwrap().into_inner();
    let names: Vec<&str> = listed.exercises.iter().map(|exercise| exercise.name.as_str()).collect();
    assert_eq!(
        names,
        ["close-wound", "cut-line", "lift-hold", "lumps-1", "lumps-2", "lumps-3", "palpate-all", "search-mark"]
    );
    let paper = server.paper(false).await;
    let watched = exercises(&server).await.watch_exercise(pb::WatchExerciseRequest { session_id: paper }).await;
    assert_eq!(told(&watched.err().unwrap()).1, "UNKNOWN_EXERCISE");
}

#[tokio::test]
async fn a_trainer_hides_another_lump_which_is_felt_and_judged_and_the_journal_has_it() {
    let folder = tempfile::tempdir().unwrap();
    let journals = folder.path().join("journals");
    let server = TestServer::start_patiently(folder.path(), &format!("journal = {journals:?}"), "");
    let (session, trainee_id) = created(&server, Some(3)).await;
    let session_id = session.session_id.clone();
    let first: Vec<_> = session.scene.unwrap().inclusions.iter().map(|lump| lump.centre_m).collect();
    let scene_of = async |id: &str| server.status(id).await.scene.unwrap();
    let plain = scene_of(&trainee_id).await;
    // One is drawn away from the others, and the second lies where the trainee will press.
    let drawn = hide(&server, &session_id, None).await.unwrap().lump.unwrap();
    assert!(!first.contains(&drawn.centre_m) && (0.008..=0.010).contains(&drawn.radius_m), "{drawn:?}");
    let centre_m = Some(pb::Vector3 { x: 0.01, y: 0.0, z: 0.027 });
    let under = pb::HiddenLump { centre_m, radius_m: 0.009, stiffness_factor: 6.0 };
    let hidden = hide(&server, &session_id, Some(under)).await.unwrap();
    assert_eq!(hidden.lump, Some(under));
    press_and_mark(&server, &trainee_id).await;
    let result = finish(&server, &trainee_id).await;
    assert!(result.step > hidden.step);
    let centres: Vec<_> = result.lumps.iter().map(|lump| lump.centre_m).collect();
    assert_eq!(centres, [&first[..], &[drawn.centre_m, centre_m]].concat());
    let value = |name: &str| result.figures.iter().find(|figure| figure.measure == name).unwrap().value;
    assert_eq!((value("hits"), value("hits") + value("misses")), (1.0, centres.len() as f64));
    // The trainer is shown all of them in the scene, the trainee none.
    assert_eq!(scene_of(&session_id).await.inclusions.len(), centres.len());
    assert_eq!(scene_of(&trainee_id).await, plain);
    assert!(plain.inclusions.is_empty());
    let without_centre = pb::HiddenLump { centre_m: None, ..under };
    let task = server.create(phased(), true).await.unwrap();
    for (id, reason, field) in
        [(&session_id, "OUT_OF_TURN", "session_id"), (&task.session_id, "NOT_AVAILABLE", "session_id")]
    {
        let (_, told_reason, told_field) = told(&hide(&server, id, None).await.unwrap_err());
        assert_eq!((told_reason.as_str(), told_field.as_str()), (reason, field));
    }
    let (other, _) = created(&server, Some(4)).await;
    for (lump, reason, field) in [
        (without_centre, "MISSING", "lump.centre_m"),
        (pb::HiddenLump { stiffness_factor: 1e3, ..under }, "OUT_OF_RANGE", "lump"),
        (pb::HiddenLump { centre_m: Some(pb::Vector3 { x: 3.0, y: 0.0, z: 0.0 }), ..under }, "OUT_OF_RANGE", "lump"),
    ] {
        let (_, told_reason, told_field) = told(&hide(&server, &other.session_id, Some(lump)).await.unwrap_err());
        assert!(told_reason == reason && told_field.starts_with(field), "{told_reason} {told_field}");
    }
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id: session_id.clone() }).await.unwrap();
    let journal = journals.join(format!("{session_id}.1.mcap"));
    // The session is computed again with the same bits, and so are the figures that need the truth.
    assert!(palpate(&["journal", "verify", journal.to_str().unwrap()]).status.success());
    let found = score(&journal, &[]).unwrap();
    assert_eq!(scored(&found), bits(&result.figures));
    assert_eq!(found.1["exercise"]["lumps"].as_array().unwrap().len(), centres.len());
    assert_eq!(found.1["exercise"]["score_percent"].as_f64(), result.score_percent);
}

/// Two phases: the first one goes on until the trainee ends it, the second one for 0.3 s.
fn phased() -> Source {
    let criterion = |measure: &str, phase: u32| {
        format!("[[criterion]]\nmeasure = \"{measure}\"\nphase = {phase}\npoor = 0\ngood = 1\n")
    };
    let text = format!(
        "name = \"mine\"\ninstructions = \"Press, then rest.\"\nscenes = [\"phantom\"]\n\
         [[phase]]\ntitle = \"Press\"\ninstructions = \"Press.\"\n\
         [[phase]]\ntitle = \"Rest\"\ninstructions = \"Rest.\"\ntime_limit_s = 0.3\n{}{}",
        criterion("press_count", 1),
        criterion("coverage_share", 2)
    );
    let source = Some(pb::chosen_exercise::Source::Text(text));
    Source::Exercise(pb::ChosenExercise { source, ..Default::default() })
}

#[tokio::test]
async fn phases_end_by_the_trainee_or_by_their_time_and_the_journal_gives_their_figures() {
    let folder = tempfile::tempdir().unwrap();
    let journals = folder.path().join("journals");
    let server = TestServer::start_patiently(folder.path(), &format!("journal = {journals:?}"), "");
    let session = server.create(phased(), false).await.unwrap();
    let told_exercise = session.exercise.clone().unwrap();
    let phases = told_exercise.exercise.unwrap().phases;
    assert_eq!((phases.len(), phases[1].title.as_str(), phases[1].time_limit_s), (2, "Rest", Some(0.3)));
    let (session_id, trainee_id) = (session.session_id, told_exercise.trainee_id);
    let watched = tokio::spawn(all(watch(&server, &trainee_id).await));
    press_and_mark(&server, &trainee_id).await;
    for (phase, reason) in [(2, "OUT_OF_TURN"), (3, "OUT_OF_RANGE")] {
        let (_, told_reason, field) = told(&end(&server, &trainee_id, phase).await.unwrap_err());
        assert_eq!((told_reason.as_str(), field.as_str()), (reason, "phase"));
    }
    assert_eq!(end(&server, &trainee_id, 1).await.unwrap(), None);
    let messages = watched.await.unwrap();
    let result = messages.last().unwrap().result.clone().unwrap();
    let numbers: BTreeSet<u32> = messages.iter().map(|message| message.phase).filter(|phase| *phase > 0).collect();
    assert_eq!(numbers, BTreeSet::from([1, 2]));
    let [press, rest] = &result.phases[..] else { panic!("{result:?}") };
    assert_eq!((press.begin_step, rest.begin_step, rest.step), (0, press.step, press.step + 300));
    assert_eq!((result.step, rest.time_s), (rest.step, 0.3));
    let value = |figures: &[pb::Figure], name: &str| {
        figures.iter().find(|figure| figure.measure == name && figure.tool.is_none()).unwrap().value
    };
    assert!(value(&press.figures, "press_count") >= 1.0 && value(&rest.figures, "press_count") == 0.0);
    let times_s = [&press.figures, &rest.figures].map(|figures| value(figures, "time_s"));
    assert!((times_s[0] + times_s[1] - result.time_s).abs() < 1e-9, "{times_s:?}");
    // A press has earned its half; nothing was done in the second phase.
    let earned: Vec<(u32, f64)> = result.criteria.iter().map(|criterion| (criterion.phase, criterion.earned)).collect();
    assert_eq!((earned, result.score_percent), (vec![(1, 1.0), (2, 0.0)], Some(50.0)));
    // What has ended stays ended.
    assert_eq!(end(&server, &session_id, 1).await.unwrap().as_ref(), Some(&result));
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id: session_id.clone() }).await.unwrap();
    let (_, json) = score(&journals.join(format!("{session_id}.1.mcap")), &[]).unwrap();
    for (told, phase) in json["exercise"]["phases"].as_array().unwrap().iter().zip(&result.phases) {
        assert_eq!(
            (told["begin_step"].as_u64(), told["steps"].as_u64()),
            (Some(phase.begin_step), Some(phase.step - phase.begin_step))
        );
        let scored = told["measures"].as_array().unwrap();
        assert_eq!(scored.len(), phase.figures.len());
        for (scored, figure) in scored.iter().zip(&phase.figures) {
            let value = scored["value"].as_f64().unwrap();
            assert!(
                scored["name"] == figure.measure.as_str() && (value - figure.value).abs() <= 1e-12 * value.abs(),
                "{scored} {figure:?}"
            );
        }
    }
    assert_eq!(json["exercise"]["score_percent"].as_f64(), Some(50.0));
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_journal_that_begins_anew_in_a_later_phase_has_the_ends_of_those_before() {
    let folder = tempfile::tempdir().unwrap();
    // No file may have more than 1.5 MiB.
    let script = "trap '' XFSZ; ulimit -f 3000; exec \"$0\" serve --listen 127.0.0.1:0 --log error --journal \"$1\"";
    let server = TestServer::by_script(script, &[folder.path().as_os_str()]);
    let text = "name = \"mine\"\ninstructions = \"Press.\"\nscenes = [\"phantom\"]\n\
                [[phase]]\ntitle = \"One\"\ninstructions = \"Press.\"\n[[phase]]\ntitle = \"Two\"\ninstructions = \"Press.\"\n";
    let source = Some(pb::chosen_exercise::Source::Text(text.to_owned()));
    let chosen = pb::ChosenExercise { source, ..Default::default() };
    let session_id = server.create(Source::Exercise(chosen), false).await.unwrap().session_id;
    assert_eq!(end(&server, &session_id, 1).await.unwrap(), None);
    let mut touch = TestTouch::hold(&server, &session_id).await;
    let (mut sequence, mut run) = (0, 1);
    let second_file = async {
        while run == 1 {
            for depth_mm in (0..50).chain((0..50).rev()) {
                sequence += 1;
                touch.command(pose(sequence, [0.01, 0.0, 0.043 - 0.0001 * f64::from(depth_mm)])).await;
                touch.sample().await;
            }
            let journal = server.status(&session_id).await.journal.unwrap();
            run = if journal.fault.is_empty() { journal.run } else { 1 };
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, second_file).await.expect("the journal does not begin anew");
    let result = finish(&server, &session_id).await;
    assert_eq!(result.phases.len(), 2);
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id: session_id.clone() }).await.unwrap();
    let (_, json) = score(&folder.path().join(format!("{session_id}.{run}.mcap")), &[]).unwrap();
    let [one, two] = &json["exercise"]["phases"].as_array().unwrap()[..] else { panic!("{json}") };
    assert_eq!((one["steps"].as_u64(), two["begin_step"].as_u64()), (Some(0), json["begin_step"].as_u64()));
    assert!(two["steps"].as_u64().unwrap() > 0, "{two}");
}

#[tokio::test]
async fn after_a_crash_a_session_has_its_exercise_its_ids_and_its_result() {
    let folder = tempfile::tempdir().unwrap();
    let config = format!("journal = {:?}", folder.path().join("journals"));
    let server = TestServer::start_patiently(folder.path(), &config, "");
    let (session, trainee_id) = created(&server, Some(3)).await;
    let session_id = session.session_id;
    hide(&server, &session_id, None).await.unwrap();
    press_and_mark(&server, &trainee_id).await;
    let result = finish(&server, &session_id).await;
    let scene = server.status(&session_id).await.scene;
    let until_durable = async {
        // The result is noted after its step.
        let reached = server.status(&session_id).await.step;
        while server.status(&session_id).await.journal.unwrap().durable_step.is_none_or(|step| step <= reached) {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    };
    // Steps of a tissue that moves are written at once.
    let (_, ()) =
        tokio::time::timeout(TEST_TIMEOUT, async { tokio::join!(press_and_mark(&server, &trainee_id), until_durable) })
            .await
            .unwrap();
    drop(server);
    let server = TestServer::start_patiently(folder.path(), &config, "");
    let seen = server.status(&trainee_id).await;
    assert!(seen.scene.unwrap().inclusions.is_empty() && seen.exercise.unwrap().finished);
    let save = server.sessions().await.save_snapshot(pb::SaveSnapshotRequest { session_id: trainee_id.clone() }).await;
    assert_eq!(told(&save.err().unwrap()).1, "NOT_FOR_TRAINEE");
    // With its time, what the criteria earned, and the answers.
    assert!(result.time_s > 0.0 && !result.criteria.is_empty() && result.answers.len() == 1, "{result:?}");
    assert_eq!(finish(&server, &session_id).await, result);
    let status = server.status(&session_id).await;
    // What the trainer had hidden is there again.
    assert_eq!((status.exercise.unwrap().seed, status.scene), (Some(3), scene));
}
