//! Streams that an administrator can cut.

use std::pin::Pin;

use futures_util::stream::{self, Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Forwards `out`. When `cut` is cancelled, ends the stream with that reason.
pub(super) fn until_cut<T: Send + 'static>(
    out: impl Stream<Item = Result<T, Status>> + Send + 'static,
    cut: CancellationToken,
) -> Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>> {
    let why = cut.clone();
    let told = stream::once(async move { why.is_cancelled().then(|| Err(palpate_realtime::streams::cut().into())) });
    out.take_until(cut.cancelled_owned()).chain(told.filter_map(std::future::ready)).boxed()
}
