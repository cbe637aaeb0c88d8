//! One viewer of a load test: it counts frames and measures their age.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use palpate_client::view::Frames;
use palpate_client::{Channel, describe};
use palpate_proto::pb;
use tonic::Status;

use super::client::{Common, LoadStage, SampleTimes, lock};

/// Begins to watch a session. Returns a future that runs the viewer to its end.
pub(crate) async fn view(
    common: Common,
    channel: Channel,
    session_id: String,
    rate_hz: f64,
    sample_times: Option<Arc<Mutex<SampleTimes>>>,
) -> Result<impl Future<Output = ()>, Status> {
    let (encoding, rate_hz) = (pb::Encoding::I16.into(), Some(rate_hz));
    let request = pb::WatchFramesRequest { session_id, encoding, rate_hz, ..Default::default() };
    Ok(watch(common, Frames::open(channel, request).await?, sample_times))
}

/// Counts a viewer's frames until the measurement ends.
async fn watch(common: Common, mut frames: Frames, sample_times: Option<Arc<Mutex<SampleTimes>>>) {
    // Used when there are no samples: arrival time minus simulated time of the least delayed frame, s.
    let mut least_s = f64::INFINITY;
    while !common.stage.is(LoadStage::DRAIN) {
        let part = match tokio::time::timeout(Duration::from_millis(200), frames.next_part()).await {
            Err(_) => continue,
            Ok(Ok(Some(part))) => part,
            Ok(Ok(None)) => return lock(&common.tally).broke("the server ended a viewer's stream".to_owned()),
            Ok(Err(status)) => return lock(&common.tally).broke(describe(&status)),
        };
        if !part.last {
            continue;
        }
        let now_ns = common.now_ns();
        #[allow(clippy::cast_precision_loss)]
        let ahead_s = now_ns as f64 * 1e-9 - part.simulation_time_s;
        least_s = least_s.min(ahead_s);
        if common.stage.is(LoadStage::MEASURE) {
            let sampled_ns = sample_times.as_ref().and_then(|sample_times| lock(sample_times).of(part.step));
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let age_ns = sampled_ns.map_or(((ahead_s - least_s) * 1e9) as u64, |at_ns| now_ns.saturating_sub(at_ns));
            let mut tally = lock(&common.tally);
            tally.frames += 1;
            tally.frame_age_ns.saturating_record(age_ns);
        }
    }
}
