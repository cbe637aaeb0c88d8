//! How burnt each vertex of a session's surface is by cautery, followed from one version to the next.

use std::time::Duration;

use palpate_proto::pb;
use pb::view_service_client::ViewServiceClient;
use tokio::sync::watch;

use crate::Error;
use crate::connect::Channel;
use crate::exchange::NewestWriter;

/// How burnt each vertex of a surface is, at one version of it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfaceBurns {
    /// The version of what is burnt, as the server counts it; 0 before anything is.
    pub version: u32,
    /// Of each vertex, the time of contact divided by that in which it burns through, 0 to 1.
    pub burn: Vec<f32>,
}

/// Time limit of a request for burns.
const BURNS_TIMEOUT: Duration = Duration::from_secs(10);

impl SurfaceBurns {
    pub(crate) fn none(vertices: usize) -> Self {
        SurfaceBurns { version: 0, burn: vec![0.0; vertices] }
    }

    /// Takes all parts of an answer that asked for what is new since this version. Parts that do not fit change nothing.
    fn take(&mut self, parts: &[pb::GetBurnsResponse]) -> Result<(), Error> {
        let burns = || parts.iter().flat_map(|part| &part.burns);
        // Also refuses what is no number.
        let fits = |of: &pb::VertexBurn| (of.vertex as usize) < self.burn.len() && (0.0..=1.0).contains(&of.burn);
        let first = parts.first().filter(|_| burns().all(fits));
        let first = first.ok_or_else(|| Error::Connection("the server's burns are of another surface".to_owned()))?;
        if !first.continues {
            self.burn.fill(0.0);
        }
        burns().for_each(|of| self.burn[of.vertex as usize] = of.burn);
        self.version = first.version;
        Ok(())
    }
}

/// Follows the burns of a surface at a refinement, up to the newest of the `wanted` versions, until their sender is gone. A request that fails is
/// made again when the next version is told, which may be the same.
pub(crate) async fn follow_burns(
    channel: Channel,
    session_id: String,
    refinement: u32,
    mut wanted: watch::Receiver<u32>,
    (mut burns, mut writer): (SurfaceBurns, NewestWriter<SurfaceBurns>),
) {
    let mut views = ViewServiceClient::new(channel);
    while wanted.changed().await.is_ok() {
        if *wanted.borrow_and_update() <= burns.version {
            continue;
        }
        let since_version = burns.version;
        let request = pb::GetBurnsRequest { session_id: session_id.clone(), refinement, since_version };
        let most = burns.burn.len();
        let answer = tokio::time::timeout(BURNS_TIMEOUT, parts(&mut views, request, most)).await;
        if let Ok(Ok(parts)) = answer
            && burns.take(&parts).is_ok()
        {
            writer.write(|written| written.clone_from(&burns));
        }
    }
}

/// Requests the burns of at most `vertices` vertices.
async fn parts(
    views: &mut ViewServiceClient<Channel>,
    request: pb::GetBurnsRequest,
    vertices: usize,
) -> Result<Vec<pb::GetBurnsResponse>, Error> {
    let mut answer = views.get_burns(request).await?.into_inner();
    // Each part counts, so that empty ones end as well.
    let (mut parts, mut room) = (Vec::new(), 2 * vertices + 1);
    while let Some(part) = answer.message().await? {
        let too_many = || Error::Connection("the server's burns have no end".to_owned());
        room = room.checked_sub(1 + part.burns.len()).ok_or_else(too_many)?;
        let is_last = part.last;
        parts.push(part);
        if is_last {
            break;
        }
    }
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(version: u32, continues: bool, burns: &[(u32, f32)]) -> pb::GetBurnsResponse {
        let burns = burns.iter().map(|&(vertex, burn)| pb::VertexBurn { vertex, burn }).collect();
        pb::GetBurnsResponse { version, continues, burns, last: true }
    }

    #[test]
    fn burns_are_added_to_those_that_are_known_or_replace_them() {
        let mut burns = SurfaceBurns::none(3);
        burns.take(&[part(2, true, &[(0, 0.5)]), part(2, true, &[(2, 1.0)])]).unwrap();
        assert_eq!(burns, SurfaceBurns { version: 2, burn: vec![0.5, 0.0, 1.0] });
        burns.take(&[part(3, true, &[(0, 0.75)])]).unwrap();
        assert_eq!(burns, SurfaceBurns { version: 3, burn: vec![0.75, 0.0, 1.0] });
        burns.take(&[part(4, false, &[(1, 0.25)])]).unwrap();
        assert_eq!(burns, SurfaceBurns { version: 4, burn: vec![0.0, 0.25, 0.0] });
    }

    #[test]
    fn burns_that_do_not_fit_change_nothing() {
        let known = SurfaceBurns { version: 2, burn: vec![0.5, 0.0, 1.0] };
        for wrong in [
            vec![],
            vec![part(3, false, &[(3, 0.5)])],
            vec![part(3, false, &[(0, 0.5)]), part(3, false, &[(1, 1.5)])],
            vec![part(3, true, &[(1, f32::NAN)])],
            vec![part(3, true, &[(1, -0.1)])],
        ] {
            let mut burns = known.clone();
            assert!(burns.take(&wrong).is_err(), "{wrong:?}");
            assert_eq!(burns, known);
        }
    }
}
