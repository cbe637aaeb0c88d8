//! The overrun policy: how much a late session catches up, what is dropped, and which session waits when a thread
//! is too slow for all. The code is pure: time is an argument.
//!
//! **Overruns.** Time steps are fixed. A session that is late catches up at most [`CATCH_UP_STEPS`] steps, and the
//! delay that the longest recent step of its thread has caused. Steps beyond that are dropped from its schedule and
//! counted; simulated time then runs slower than real time.
//!
//! **Fair parts.** The session that is due first is stepped first, so sessions of any rates are all on time while
//! there is time for all. If there is not, a session that takes no more than its part of the thread is still
//! stepped when it is due. A session that takes more and is late goes after all that are due. The thread is divided
//! equally among the callers whose sessions are awake, and each caller's part among its sessions: a caller that
//! wakes four hundred sessions at once slows only those. So between two steps of a session that is too heavy all
//! others are stepped, and it gets the remaining time. A step can't be interrupted: the longest recent one may have
//! made every session late, and each catches that up, however many steps it is.
//!
//! **Turns.** A session that was on time is stepped when it is due, even if its caller has woken four hundred at
//! once. After [`MAX_TURN_NS`] of steps of one caller, a due session of another caller comes first.
//!
//! **Apart.** A step that takes longer than its period, and longer than [`MAX_STEP_NS`], makes all other sessions
//! of the thread late, however the time is divided: a scene may be light and its tools heavy. A session with such
//! steps moves from a shared thread to one of lower priority, and stays there. So such sessions are late without
//! delaying others.

/// Number of steps that a session may be late before further ones are dropped.
const CATCH_UP_STEPS: f64 = 2.0;

/// Returns the number of steps to drop from the schedule of a session whose next step was due `late_ns` ago.
/// `forgiven_ns` of that was caused by other sessions. It is called before each step.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn dropped_steps(late_ns: u64, forgiven_ns: u64, period_ns: f64) -> u64 {
    let behind = (late_ns.saturating_sub(forgiven_ns) as f64 / period_ns).floor();
    // A negative number becomes 0.
    (behind - CATCH_UP_STEPS) as u64
}

/// Returns the number of equal parts that a thread is divided into for one session: `callers` have awake sessions,
/// and the session's caller has `siblings` of them, including this one.
pub(super) fn parts(callers: usize, siblings: usize) -> usize {
    callers * siblings
}

/// Limit of consecutive time for one caller's steps while a session of another caller is due, ns.
const MAX_TURN_NS: u64 = 500_000;

/// The caller whose steps a thread does at present, one after the other.
#[derive(Debug, Default)]
pub(super) struct CallerTurn {
    caller: u64,
    begun_ns: u64,
}

impl CallerTurn {
    /// Notes that a step of a caller begins. If that caller's turn was over, no other caller had a due step.
    pub(super) fn step(&mut self, caller: u64, begun_ns: u64) {
        if caller != self.caller || self.is_over_for(begun_ns).is_some() {
            *self = CallerTurn { caller, begun_ns };
        }
    }

    /// Returns the caller whose turn is over, if it is.
    pub(super) fn is_over_for(&self, now_ns: u64) -> Option<u64> {
        (now_ns > self.begun_ns + MAX_TURN_NS).then_some(self.caller)
    }
}

/// Duration of a step that never counts as too long, ns.
const MAX_STEP_NS: u64 = 2_000_000;

/// Number of steps whose processor time is measured after a step that took too long. Only the processor time shows
/// that the steps are too long.
const MEASURED_STEPS: u32 = 64;

/// Detects a session whose steps take too long for the others of its thread. A long step may also have waited for
/// the processor, and measuring the processor time of every step would cost too much.
#[derive(Debug, Default)]
pub(super) struct StepWatch {
    to_measure: u32,
}

impl StepWatch {
    /// Returns whether the processor time of the coming step is to be measured.
    pub(super) fn measures(&self) -> bool {
        self.to_measure > 0
    }

    /// Notes a step that took `took_ns`, with `worked_ns` of processor time if that was measured. Returns whether
    /// its measured time is too long.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn is_too_long(&mut self, took_ns: u64, worked_ns: Option<u64>, period_ns: f64) -> bool {
        let is_long = |ns: u64| ns > MAX_STEP_NS && ns as f64 > period_ns;
        self.to_measure = self.to_measure.saturating_sub(1);
        if is_long(took_ns) {
            self.to_measure = MEASURED_STEPS;
        }
        worked_ns.is_some_and(is_long)
    }
}

/// A session that is queued among the others of its thread, after a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Turn {
    /// Time at which its next step is due, ns.
    pub(super) due_ns: u64,
    /// Time between two steps, ns.
    pub(super) period_ns: f64,
    /// Fraction of the thread that its steps take.
    pub(super) share: f64,
    /// Number of equal parts of the thread of which one is its own ([`parts`]).
    pub(super) parts: usize,
    /// Whether no other session of the thread has a due time.
    pub(super) is_alone: bool,
}

impl Turn {
    /// Returns the time before which the session is not stepped, ns: `now_ns` if it is late and takes more than its
    /// part, so that it goes after all that are due by then; else 0.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn not_before_ns(&self, now_ns: u64) -> u64 {
        let is_late = now_ns.saturating_sub(self.due_ns) as f64 > self.period_ns;
        let takes_more = self.share * self.parts as f64 > 1.0;
        if !self.is_alone && is_late && takes_more { now_ns } else { 0 }
    }
}

/// The longest recent step of a thread: no session is to blame for being late by as much.
#[derive(Debug, Default)]
pub(super) struct Longest {
    /// The longest step of the present window and of the last one, ns.
    now_ns: u64,
    before_ns: u64,
    since_ns: u64,
}

/// Length of the windows, ns.
const WINDOW_NS: u64 = 250_000_000;

/// Limit of the step length that is forgiven, ns.
const MAX_NS: u64 = 100_000_000;

impl Longest {
    /// Notes a step that ended at `now_ns` and took `took_ns`.
    pub(super) fn observe(&mut self, now_ns: u64, took_ns: u64) {
        if now_ns.saturating_sub(self.since_ns) > WINDOW_NS {
            (self.before_ns, self.now_ns, self.since_ns) = (self.now_ns, 0, now_ns);
        }
        self.now_ns = self.now_ns.max(took_ns.min(MAX_NS));
    }

    /// Returns the length of the longest recent step, ns.
    pub(super) fn ns(&self) -> u64 {
        self.now_ns.max(self.before_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_session_catches_up_two_steps_and_what_is_not_its_fault() {
        let period_ns = MS as f64;
        for (late_ms, forgiven_ms, dropped) in [(0, 0, 0), (2, 0, 0), (3, 0, 1), (10, 0, 8), (10, 7, 1), (10, 20, 0)] {
            let found = dropped_steps(late_ms * MS, forgiven_ms * MS, period_ns);
            assert_eq!(found, dropped, "{late_ms} {forgiven_ms}");
        }
        // Parts of a step are not dropped.
        assert_eq!(dropped_steps(4 * MS - 1, 0, period_ns), 1);
    }

    #[test]
    fn the_page_on_the_protocol_tells_how_many_steps_a_session_catches_up() {
        let words: Vec<_> = include_str!("../../../docs/protocol.md").split_whitespace().collect();
        let number = ["no", "one", "two", "three", "four"][CATCH_UP_STEPS as usize];
        assert!(words.join(" ").contains(&format!("that is late catches up {number} steps")), "{number}");
    }

    /// A session whose next step is due at 2 ms, at 1 kHz.
    fn turn(share: f64, parts: usize) -> Turn {
        Turn { due_ns: 2 * MS, period_ns: MS as f64, share, parts, is_alone: parts == 1 }
    }

    #[test]
    fn a_session_that_is_late_and_takes_more_than_its_part_goes_after_all_that_are_due() {
        assert_eq!(turn(2.0, 2).not_before_ns(7 * MS), 7 * MS);
        // Late through no fault of its own, alone on its thread, or heavy but on time.
        assert_eq!(turn(0.01, 2).not_before_ns(7 * MS), 0);
        assert_eq!(turn(2.0, 1).not_before_ns(7 * MS), 0);
        assert_eq!(turn(2.0, 2).not_before_ns(2 * MS), 0);
    }

    #[test]
    fn a_thread_is_divided_among_callers_first() {
        // 40 sessions of one caller take 2 ms of each millisecond together; one session of another keeps its time.
        let (many, one) = (turn(0.05, parts(2, 40)), turn(0.05, parts(2, 1)));
        assert_eq!((many.not_before_ns(10 * MS), one.not_before_ns(10 * MS)), (10 * MS, 0));
    }

    #[test]
    fn the_turn_of_a_caller_is_over_after_half_a_millisecond_of_its_steps() {
        let mut turn = CallerTurn::default();
        turn.step(7, MS);
        turn.step(7, MS + MS / 4);
        assert_eq!((turn.is_over_for(MS + MS / 2), turn.is_over_for(MS + MS / 2 + 1)), (None, Some(7)));
        turn.step(7, 2 * MS);
        assert_eq!(turn.is_over_for(2 * MS + 1), None);
        turn.step(8, 2 * MS);
        turn.step(7, 2 * MS + 1);
        assert_eq!(turn.is_over_for(2 * MS + 2), None);
    }

    #[test]
    fn a_session_whose_steps_keep_the_processor_busy_for_too_long_goes_apart() {
        let period_ns = MS as f64;
        let mut watch = StepWatch::default();
        // Within 2 ms, or within its period, or not running.
        assert!(!watch.is_too_long(2 * MS, None, period_ns) && !watch.measures());
        assert!(!watch.is_too_long(20 * MS, None, 20.0 * period_ns) && !watch.measures());
        assert!(!watch.is_too_long(4500 * MS, None, period_ns) && watch.measures());
        for _ in 0..MEASURED_STEPS {
            assert!(watch.measures() && !watch.is_too_long(MS, Some(MS), period_ns));
        }
        assert!(!watch.measures());
        // The second such step decides.
        assert!(!watch.is_too_long(3 * MS, None, period_ns) && watch.measures());
        assert!(!watch.is_too_long(9 * MS, Some(MS / 2), period_ns) && watch.measures());
        assert!(watch.is_too_long(3 * MS, Some(3 * MS), period_ns));
    }

    #[test]
    fn a_long_step_is_forgiven_for_a_while_and_within_reason() {
        let mut longest = Longest::default();
        longest.observe(1, 5_000_000);
        longest.observe(2, 1000);
        assert_eq!(longest.ns(), 5_000_000);
        longest.observe(3, 10_000_000_000);
        assert_eq!(longest.ns(), MAX_NS);
        for window in 1..4 {
            longest.observe(window * (WINDOW_NS + 1) + 3, 1000);
        }
        assert_eq!(longest.ns(), 1000);
    }
}
