//! Work of milliseconds or more that a call waits for (a session laid out, a force law, a texture): one piece at a time, on
//! a thread that gives way to those that step. So to ask for much of it delays nobody but who asks.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

use tokio::sync::{Semaphore, oneshot};
use tonic::Status;

use crate::pace::priority::give_way;

type Job = Box<dyn FnOnce() + Send>;

/// A thread for heavy work. It ends with the last clone.
#[derive(Clone)]
pub(crate) struct Workshop {
    turns: Arc<Semaphore>,
    jobs: SyncSender<Job>,
}

impl Workshop {
    /// Starts the thread.
    pub(crate) fn open(name: &str) -> std::io::Result<Self> {
        // Whoever has the turn finds room: the job before has been taken out.
        let (jobs, waiting) = sync_channel::<Job>(1);
        std::thread::Builder::new().name(name.into()).spawn(move || {
            give_way();
            waiting.into_iter().for_each(|job| job());
        })?;
        Ok(Workshop { turns: Arc::new(Semaphore::new(1)), jobs })
    }

    /// Does `work` when it is its turn. Who hangs up before that is passed over.
    pub(crate) async fn work<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Status> {
        let failed = || Status::internal("a fault of the program ended what was asked for");
        let turn = self.turns.clone().acquire_owned().await.map_err(|_| failed())?;
        let (done, result) = oneshot::channel();
        let job = move || {
            let answer = catch_unwind(AssertUnwindSafe(work));
            drop(turn);
            if let Ok(answer) = answer {
                let _ = done.send(answer);
            }
        };
        self.jobs.try_send(Box::new(job)).map_err(|_| failed())?;
        result.await.map_err(|_| failed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn work_is_done_one_piece_after_another_whatever_becomes_of_one() {
        let workshop = Workshop::open("test").unwrap();
        let faulty = workshop.work(|| -> u32 { panic!("a test") }).await;
        assert_eq!(faulty.unwrap_err().code(), tonic::Code::Internal);
        // Who gives up waiting for a turn leaves nothing behind.
        let slow = workshop.work(|| std::thread::sleep(std::time::Duration::from_millis(20)));
        let given_up = tokio::time::timeout(std::time::Duration::ZERO, workshop.work(|| ()));
        assert!(tokio::join!(slow, given_up).0.is_ok());
        let all = (0..20).map(|number| workshop.work(move || number));
        let done = futures_util::future::join_all(all).await;
        assert_eq!(done.into_iter().map(Result::unwrap).collect::<Vec<_>>(), (0..20).collect::<Vec<_>>());
    }
}
