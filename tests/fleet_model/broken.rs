//! What is broken on purpose, so that the checks are seen to fail.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Broken {
    Nothing,
    /// Clocks differ by ± 30 %.
    Clocks,
    /// The fence is at 1.2 times the time to live.
    FenceLate,
    /// A claim does not look at the owner's key.
    ClaimBlind,
    /// A node keeps a session whatever the revision.
    KeepBlind,
    /// A session is deleted whatever the revision.
    DeleteBlind,
    /// What the other node has is called durable before etcd names that node.
    DurableEarly,
    /// A session runs while it is handed over.
    MoveRunning,
    /// A client takes samples of any revision.
    ClientTakesAll,
    /// The owner does not learn the revision of what it has written itself and heard no answer of.
    StaleRevision,
    /// After a handing over whose end is unknown, the owner only reads who has the session.
    HandOverLate,
    /// A node that is handed a session reads the owner only once when it gets no message.
    TakeReadsOnce,
    /// A node that is handed a session asks etcd only when the stream has ended.
    TakeWaits,
    /// A node that is handed a session confirms before it is on the disk.
    TakeInMemory,
    /// After a crash a node looks only at its own journals, not at those for which it stood by.
    RestartIgnoresStandby,
    /// A node sends on the journal of a session that is only being handed to it.
    MirrorComing,
    /// A node that joins does not keep its lease, and passes over what it can't keep.
    JoinSkips,
    /// A node that is handed a session may claim it at once.
    ClaimComing,
    /// A claim whose end is unknown is forgotten.
    ClaimForgotten,
    /// Journals of runs that have ended otherwise count when a session is claimed.
    OldRunsCount,
    /// The standby is written to etcd only when the journal grows.
    StandbyToldOnce,
    /// A node claims only sessions that no node sends to it.
    ClaimAwaitsStream,
    /// A standby forgets its journal as soon as etcd names another.
    ForgetSoon,
    /// What the old standby has counts while another is being named.
    CountsBoth,
    /// The owner ends the old standby as soon as there is a better one.
    EndSoon,
    /// What a standby said before it heard that it shall forget a session counts.
    CountsEnded,
    /// A deletion is confirmed whether or not etcd has done it.
    DeleteUnsure,
    /// A node that joins deletes entries of sessions that it does not have, also those that came since.
    SettleAll,
    /// A node that has another lease lists the nodes anew, beside its watch.
    ListOverWatch,
    /// A standby accepts journals of older runs than it has.
    OlderRuns,
    /// A node's report on itself may put its key under an older lease.
    TellAnyLease,
}
