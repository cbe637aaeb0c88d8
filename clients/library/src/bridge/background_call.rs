//! One call at a time in a task of its own, while the haptic stream goes on.

use tokio::task::JoinSet;

use crate::Error;

/// At most one call, which is aborted when this is dropped.
pub(super) struct BackgroundCall<T> {
    under_way: JoinSet<Result<T, Error>>,
}

impl<T: Send + 'static> BackgroundCall<T> {
    pub(super) fn none() -> Self {
        BackgroundCall { under_way: JoinSet::new() }
    }

    pub(super) fn is_under_way(&self) -> bool {
        !self.under_way.is_empty()
    }

    /// Begins a call. Aborts one that is under way.
    pub(super) fn begin(&mut self, call: impl Future<Output = Result<T, Error>> + Send + 'static) {
        self.abort();
        self.under_way.spawn(call);
    }

    /// Aborts the call under way, if any.
    pub(super) fn abort(&mut self) {
        self.under_way.abort_all();
        self.under_way.detach_all();
    }

    /// Waits for the end of the call under way. Never returns without a call. Dropping the future loses nothing.
    pub(super) async fn result(&mut self) -> Result<T, Error> {
        let Some(ended) = self.under_way.join_next().await else { return std::future::pending().await };
        ended.map_err(|_| Error::Internal("a call in the background panicked".to_owned()))?
    }
}
