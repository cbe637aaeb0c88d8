//! Measured curves beside those of a session's tissue.

use std::fmt::Write;

use crate::common::server::{TestServer, told};
use palpate_proto::pb;
use pb::create_session_request::Source;
use tonic::{Code, Status};

/// Two presses of 4 mm in 0.1 s, by discs of two radii, with a force for each sample.
fn table(force_n: impl Fn(usize, usize) -> f64) -> String {
    let mut text = "curve,tip_radius_mm,time_ms,depth_mm,force_n\n".to_owned();
    for (curve, (name, radius_mm)) in [("small", 60), ("wide", 120)].into_iter().enumerate() {
        for sample in 0..=20 {
            let (time_ms, depth_mm, force_n) = (5 * sample, 0.2 * sample as f64, force_n(curve, sample));
            let _ = writeln!(text, "{name},{radius_mm},{time_ms},{depth_mm:?},{force_n:?}");
        }
    }
    text
}

async fn compare(server: &TestServer, session_id: &str, table: String) -> Result<pb::CompareCurvesResponse, Status> {
    let request = pb::CompareCurvesRequest {
        session_id: session_id.to_owned(),
        file_name: "a/folder/lab.csv".to_owned(),
        table,
        tip: None,
    };
    Ok(server.sessions().await.compare_curves(request).await?.into_inner())
}

#[tokio::test]
async fn the_curves_of_the_tissue_itself_differ_by_nothing_and_the_session_feels_nothing() {
    let server = TestServer::start(&[]);
    let session_id = server.paper(true).await;
    let before = server.hash_at(&session_id, 0).await;
    let first = compare(&server, &session_id, table(|_, _| 1.0)).await.unwrap();
    let names: Vec<_> = first.curves.iter().map(|curve| (curve.name.as_str(), curve.tip.unwrap().radius_m)).collect();
    assert_eq!(names, [("small", 0.06), ("wide", 0.12)]);
    let computed = |answer: &pb::CompareCurvesResponse, curve: usize| answer.curves[curve].computed_n.clone();
    let (small, wide) = (computed(&first, 0), computed(&first, 1));
    assert!(small.len() == 21 && small[20] > small[10] && small[10] > 0.0 && wide[20] > small[20], "{first:?}");
    let again = compare(&server, &session_id, table(|curve, sample| [&small, &wide][curve][sample])).await.unwrap();
    assert_eq!((again.rms_n, again.relative_rms, again.r_squared), (0.0, 0.0, 1.0));
    let off = compare(&server, &session_id, table(|curve, sample| [&small, &wide][curve][sample] - 0.1)).await.unwrap();
    assert!((off.rms_n - 0.1).abs() < 1e-12 && off.r_squared < 1.0, "{off:?}");
    assert!(off.curves.iter().all(|curve| (curve.rms_n - 0.1).abs() < 1e-12));
    assert_eq!(server.hash_at(&session_id, 0).await, before);
    // A changed tissue is compared as it is now.
    let change = pb::UpdateTissueRequest {
        session_id: session_id.clone(),
        stiffness_n_per_m: Some(20.0),
        anchor_stiffness_n_per_m: Some(20.0),
        ..Default::default()
    };
    server.sessions().await.update_tissue(change).await.unwrap();
    server.start_until(&session_id, 1).await;
    // The change acts from that step on.
    server.hash_at(&session_id, 1).await;
    let stiffer = compare(&server, &session_id, table(|_, _| 1.0)).await.unwrap();
    assert!(computed(&stiffer, 0)[20] > 1.5 * small[20], "{stiffer:?}");
}

#[tokio::test]
async fn a_table_that_can_not_be_pressed_is_refused_with_what_is_wrong_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let server = TestServer::start_patiently(folder.path(), "", "press_work = 1000000");
    let session_id = server.paper(true).await;
    let header = "time_s,depth_m,force_n";
    let many: String = (0..20_001).map(|k| format!("{k}e-5,0,0\n")).collect();
    for (table, code, reason, field, says) in [
        ("time_s,force_n\n0,0\n".to_owned(), Code::InvalidArgument, "MISSING", "depth_m", "lab.csv:1: depth_m"),
        (format!("{header}\n0,0,x\n"), Code::InvalidArgument, "UNREADABLE", "force_n", "lab.csv:2: force_n: `x`"),
        (format!("{header}\n{many}"), Code::ResourceExhausted, "TOO_LARGE", "table", "20001 samples, more than 20000"),
        (format!("{header}\n0,0,0\n60,0.001,1\n"), Code::ResourceExhausted, "TOO_LARGE", "table", "limits.press_work"),
        (
            format!("{header},tip\n0,0,0,sphere\n0.1,0.001,1,sphere\n"),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "table",
            "the curve `` can't be pressed into this tissue",
        ),
    ] {
        let refused = compare(&server, &session_id, table).await.unwrap_err();
        assert_eq!(told(&refused), (code, reason.to_owned(), field.to_owned()), "{refused:?}");
        assert!(refused.message().contains(says) && !refused.message().contains("folder"), "{}", refused.message());
    }
    let unknown = compare(&server, "nobody", table(|_, _| 0.0)).await.unwrap_err();
    assert_eq!(told(&unknown), (Code::NotFound, "UNKNOWN_SESSION".into(), "session_id".into()));
    for (shape, radius_m, field) in
        [(pb::TipShape::Disc, 0.0, "tip.radius_m"), (pb::TipShape::Disc, f64::NAN, "tip.radius_m")]
    {
        let request = pb::CompareCurvesRequest {
            session_id: session_id.clone(),
            table: format!("{header}\n0,0,0\n0.1,0.001,1\n"),
            tip: Some(pb::Tip { shape: shape.into(), radius_m, ..Default::default() }),
            ..Default::default()
        };
        let refused = server.sessions().await.compare_curves(request).await.unwrap_err();
        assert_eq!(told(&refused).2, field);
    }
}

#[tokio::test]
async fn a_table_without_a_tip_is_pressed_by_that_of_the_request() {
    let server = TestServer::start(&[]);
    let session = server.create(Source::SceneName("phantom".into()), true).await.unwrap();
    let pressed = async |tip: Option<pb::Tip>| {
        let request = pb::CompareCurvesRequest {
            session_id: session.session_id.clone(),
            table: "time_s,depth_mm,force_n\n0,0,0\n0.05,0.5,1\n0.1,1,1\n".to_owned(),
            tip,
            ..Default::default()
        };
        server.sessions().await.compare_curves(request).await.unwrap().into_inner().curves.remove(0)
    };
    let usual = pressed(None).await;
    assert_eq!((usual.name.as_str(), usual.tip.unwrap().radius_m), ("", 0.005));
    let rigid = pb::Tip { shape: pb::TipShape::RigidDisc.into(), radius_m: 0.012, ..Default::default() };
    let wide = pressed(Some(rigid)).await;
    assert_eq!((wide.tip.unwrap().shape(), wide.tip.unwrap().radius_m), (pb::TipShape::RigidDisc, 0.012));
    assert!(wide.computed_n[2] > 1.5 * usual.computed_n[2], "{wide:?} {usual:?}");
}
