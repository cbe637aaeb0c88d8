//! Simulated trainees find lumps through a server, by what they feel: scores tell an expert from others, and coverage is what was pressed.
//!
//! `PALPATE_TRAINEE_SEEDS=20` tries so many truths of each level with all kinds of trainees, and prints how well the score separates them;
//! half an hour or more on two cores. `PALPATE_TRAINEE_LEVELS=lumps-2,lumps-3` leaves out the other level.

use palpate_client::{Credentials, Server};
use palpate_proto::pb;
use palpate_simulated::trainee::{FINGER_M, TraineeKind, TraineeWork, do_exercise};
use pb::create_session_request::Source;
use pb::exercise_service_client::ExerciseServiceClient;

use crate::common::server::TestServer;

/// What one trainee did, and its result.
struct TraineeResult {
    work: TraineeWork,
    result: pb::ExerciseResult,
}

impl TraineeResult {
    fn figure(&self, name: &str) -> f64 {
        let of = |figure: &&pb::Figure| figure.measure == name && figure.tool.is_none();
        self.result.figures.iter().find(of).map(|figure| figure.value).unwrap()
    }
}

async fn one(server: &TestServer, level: &str, kind: TraineeKind, seed: u64) -> TraineeResult {
    let source = Some(pb::chosen_exercise::Source::Name(level.to_owned()));
    let chosen = pb::ChosenExercise { source, seed: Some(seed), scene_name: String::new() };
    let session = server.create(Source::Exercise(chosen), false).await.unwrap();
    let trainee_id = session.exercise.unwrap().trainee_id;
    let channel = Server::new(&server.url, &Credentials::default()).unwrap().connect().await.unwrap();
    let work = do_exercise(channel.clone(), &trainee_id, kind, seed).await.unwrap();
    let request = pb::FinishExerciseRequest { session_id: trainee_id, phase: 0 };
    let finished = ExerciseServiceClient::new(channel).finish_exercise(request).await.unwrap();
    let delete = pb::DeleteSessionRequest { session_id: session.session_id };
    server.sessions().await.delete_session(delete).await.unwrap();
    TraineeResult { work, result: finished.into_inner().result.unwrap() }
}

/// The share of a square of 100 mm that lies under a fingertip at one of the places.
fn pressed_share(work: &TraineeWork) -> f64 {
    let cells = 200;
    let middle_m = |cell: u32| (f64::from(cell) + 0.5) * 0.1 / f64::from(cells) - 0.05;
    let is_pressed = |x_m: f64, y_m: f64| {
        // A force of 2000 Pa on the whole fingertip.
        let enough_n = 2000.0 * std::f64::consts::PI * FINGER_M * FINGER_M;
        work.presses.iter().any(|press| {
            let away_m = (press.place_m.x - x_m).hypot(press.place_m.y - y_m);
            press.force_n >= enough_n && away_m <= FINGER_M
        })
    };
    let pressed = (0..cells).flat_map(|x| (0..cells).map(move |y| (middle_m(x), middle_m(y))));
    pressed.filter(|(x_m, y_m)| is_pressed(*x_m, *y_m)).count() as f64 / f64::from(cells * cells)
}

/// The probability that a score of the one is above one of the other; equal scores count half.
fn auc(one: &[f64], other: &[f64]) -> f64 {
    let above = |one: f64, other: f64| if one > other { 1.0 } else { f64::from(u8::from(one == other)) / 2.0 };
    let sum: f64 = one.iter().flat_map(|one| other.iter().map(move |other| above(*one, *other))).sum();
    sum / (one.len() * other.len()) as f64
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_expert_scores_above_others_and_the_coverage_is_what_was_pressed() {
    // More sessions than a small machine can step in real time: their time slows down, and what is done in them stays the same.
    let folder = tempfile::tempdir().unwrap();
    let server = TestServer::start_patiently(folder.path(), "threads = 2", "thread_share = 100.0");
    let seeds: u64 = std::env::var("PALPATE_TRAINEE_SEEDS").map_or(1, |seeds| seeds.parse().unwrap());
    let (levels, kinds): (&[&str], &[TraineeKind]) = match seeds {
        1 => (&["lumps-1"], &[TraineeKind::Expert, TraineeKind::Hurried]),
        _ => (&["lumps-1", "lumps-2", "lumps-3"], &TraineeKind::ALL),
    };
    let chosen = std::env::var("PALPATE_TRAINEE_LEVELS").unwrap_or_default();
    for level in levels.iter().filter(|level| chosen.is_empty() || chosen.split(',').any(|chosen| chosen == **level)) {
        let mut scores: Vec<Vec<f64>> = vec![Vec::new(); kinds.len()];
        for seed in 1..=seeds {
            let trained = kinds.iter().map(|kind| one(&server, level, *kind, 1000 + seed));
            for ((trained, kind), scores) in
                futures_util::future::join_all(trained).await.into_iter().zip(kinds).zip(&mut scores)
            {
                let score = trained.result.score_percent.unwrap();
                let [hits, misses, alarms, coverage, peak_n] =
                    ["hits", "misses", "false_alarms", "coverage_share", "peak_force_n"]
                        .map(|name| trained.figure(name));
                let pressed = pressed_share(&trained.work);
                println!(
                    "{level} seed {seed} {kind:?}: {score:.1} %, hits {hits}, misses {misses}, false alarms {alarms}, coverage \
                     {coverage:.3} (pressed {pressed:.3}), {peak_n:.2} N, {:.1} s",
                    trained.result.time_s
                );
                assert!((coverage - pressed).abs() < 0.03, "coverage {coverage}, pressed {pressed}");
                assert_eq!(trained.result.answers.len(), trained.work.marks_m.len());
                scores.push(score);
            }
        }
        for (kind, others) in kinds.iter().zip(&scores).skip(1) {
            let auc = auc(&scores[0], others);
            println!("{level}: AUC of the expert against {kind:?}: {auc:.3}");
            assert!(auc >= 0.95, "{level}: {auc} against {kind:?}");
        }
    }
}
