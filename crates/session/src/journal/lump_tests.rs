//! Lumps that are added while a session runs: a journal has them, and a replay gives the same bits.

use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

use glam::DVec3;

use super::message::{from_tissue, tissue};
use super::{JournalReader, JournalWriter, Replay, pb};
use crate::input::Input;
use crate::simulation::Simulation;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::exercise::Lump;
use palpate_tissue::scene::script::Script;
use palpate_tissue::select::scheme_selection::NEVER;

/// A block with an inclusion, and an organ of triangles with one; each with the lump that is added, and where it is pressed.
fn tissues() -> [(Arc<Model>, Lump, DVec3); 2] {
    let block = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                 fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                 [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.4\n\
                 [[inclusion]]\ncentre_m = [-0.03, 0, 0.03]\nradius_m = 0.012\nstiffness_factor = 4\n";
    let lump = Lump { centre_m: DVec3::new(0.02, 0.0, 0.03), radius_m: 0.012, stiffness_factor: 6.0 };
    let top_m = DVec3::new(0.02, 0.0, 0.04);
    let even = Model::parse("organ", crate::GALLBLADDER, &[]).unwrap();
    let vertex_m = even.shape().rest_m(even.points().next().unwrap());
    let DVec3 { x, y, z } = vertex_m;
    let inclusion =
        format!("inclusion=[{{ centre_m = [{x:?}, {y:?}, {z:?}], radius_m = 0.01, stiffness_factor = 2.0 }}]");
    let organ = Model::parse("organ", crate::GALLBLADDER, &[&inclusion]).unwrap();
    assert_ne!(organ.scene.body, even.scene.body);
    assert_eq!(organ.scene.without_inclusions().unwrap(), even.scene);
    let near = Lump { centre_m: vertex_m, radius_m: 0.012, stiffness_factor: 3.0 };
    [(Model::parse("block", block, &[]).unwrap(), lump, top_m), (organ, near, vertex_m)]
}

#[test]
fn a_lump_is_felt_from_the_step_on_at_which_it_is_added_and_a_replay_has_it_with_the_same_bits() {
    for (model, lump, place_m) in tissues() {
        let limits = Limits::default();
        let name = &model.scene.name;
        let DVec3 { x, y, z } = place_m;
        let text = format!(
            "duration_s = 0.3\nsample_every_s = 0.1\n[[force]]\nat_m = [{x:?}, {y:?}, {z:?}]\nforce_n = [0, 0, -0.2]\n\
             falloff_per_m = 100.0\nfalloff_offset = 0.0\nprofile = {{ type = \"pulse\", on_s = 0.02, off_s = 0.29 }}\n"
        );
        let script = Script::parse("press", &text, Path::new(""), &model.scene, &limits).unwrap();
        let mut writer = JournalWriter::at_rest(&model);
        let mut simulation = Simulation::playing(&model, &script, true, &limits).unwrap();
        let mut without = Simulation::playing(&model, &script, true, &limits).unwrap();
        let lumped = model.with_lump_until(&lump, &limits, &NEVER).unwrap();
        for step in 0..script.steps {
            simulation.take_inputs(0).unwrap();
            if step == 150 {
                assert_eq!(simulation.session.tissue().state_hash(), without.session.tissue().state_hash(), "{name}");
                writer.input(step, &Input::Tissue(lumped.clone()));
                simulation.session.change(&lumped);
            }
            for due in &simulation.due {
                writer.input(step, &Input::Command(due.clone()));
            }
            simulation.session.advance(&mut simulation.due, |_| {});
            without.take_inputs(0).unwrap();
            without.session.advance(&mut without.due, |_| {});
            if step == 200 {
                let session = &simulation.session;
                writer.snapshot(201, session.tissue().state_hash(), session.model(), session.save().to_bytes());
            }
        }
        let end = &simulation.session;
        writer.hash(end.step_count(), end.tissue().state_hash());
        assert_ne!(end.tissue().state_hash(), without.session.tissue().state_hash(), "{name}: nothing is felt");
        let journal = writer.finish(pb::Why::Drained, "", script.steps, 1);
        // From the beginning, by way of the change, and from the snapshot behind it.
        for from in [0, 250] {
            let mut reader = JournalReader::new("lumps.mcap", Cursor::new(journal.clone())).unwrap();
            if from == 0 {
                let survey = reader.survey(&mut |_| {}).unwrap();
                let verdict = Replay::new(reader, survey, &limits).unwrap().verify(&mut |_, _| {}).unwrap();
                assert!(verdict.difference.is_none() && verdict.proved_until == script.steps, "{name}: {verdict:?}");
            } else {
                let (session, first) = super::session_at(reader, &limits, from, &NEVER).unwrap();
                assert_eq!((session.step_count(), &session.model().scene.added_lumps[..]), (from, &[lump][..]));
                assert!(first.scene.added_lumps.is_empty(), "{name}");
            }
        }
    }
}

#[test]
fn the_message_of_a_tissue_has_its_added_lumps_and_without_inclusions_it_has_none() {
    for (model, lump, _) in tissues() {
        let limits = Limits::default();
        let lumped = model.with_lump_until(&lump, &limits, &NEVER).unwrap();
        let again = from_tissue(&tissue(&lumped), &model, &limits).unwrap();
        assert_eq!((&again.scene, again.saved_plan()), (&lumped.scene, lumped.saved_plan()));
        assert_eq!(again.scene.inclusions, model.scene.inclusions);
        // A trainee's tissue: whatever was put in, nothing of it is left.
        let plain = model.scene.without_inclusions().unwrap();
        assert_eq!(lumped.scene.without_inclusions().unwrap(), plain);
        assert_eq!(plain.with_lump(&lump).unwrap().without_inclusions().unwrap(), plain);
        assert_ne!(plain.with_added_lumps(&[lump]).unwrap().body, plain.body);
        // One far away reaches nothing of it.
        let off = Lump { centre_m: DVec3::splat(10.0), ..lump };
        assert_eq!(model.with_lump_until(&off, &limits, &NEVER).unwrap_err().field, "lump[1].radius_m");
    }
}
