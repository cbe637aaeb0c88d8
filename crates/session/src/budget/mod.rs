//! Resources that callers share: memory, sessions, streams, leases, and processor time. One rule divides them all.
//!
//! A caller may take in proportion to what is left: its own amount is at most (1 − r)/r of the rest, where r is the
//! part that a single caller must leave. So a single caller gets all but r; two callers that want as much as
//! possible get equal amounts; and something is always left for the next. No part has to be configured, and none
//! lies idle.
//!
//! An amount that was taken is a [`Taken`], which gives it back when it is dropped. Time is an argument here.

mod machine;
mod time;
mod turns;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Weak};

pub use machine::{give_back_to_the_system, half_of_the_machine, parse_bytes, set_up_allocator};
use time::RecentTime;
pub use time::Work;
pub use turns::Turns;

use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;

/// Purpose for which memory is taken; the metrics show each. All purposes share one pool of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The state of a session, its checkpoint, and the scene.
    Session,
    /// Changed tissues that wait for their step.
    Change,
    /// Frames of viewers, and what waits for them.
    Frames,
    /// Records that wait for their reader.
    Records,
    /// Commands that wait for their step.
    Commands,
    /// Textures that are kept or computed.
    Textures,
    /// Data that clients have sent and the server has not read, and data that clients have not taken.
    Connections,
    /// Force laws that sessions keep.
    Laws,
    /// Meshes that clients have sent.
    Meshes,
    /// Journals that clients have sent.
    Journals,
    /// Requests that are being answered, decoded.
    Requests,
}

impl Purpose {
    /// Every purpose, in the order of declaration.
    pub const ALL: [Purpose; 11] = [
        Purpose::Session,
        Purpose::Change,
        Purpose::Frames,
        Purpose::Records,
        Purpose::Commands,
        Purpose::Textures,
        Purpose::Connections,
        Purpose::Laws,
        Purpose::Meshes,
        Purpose::Journals,
        Purpose::Requests,
    ];

    /// Returns the name of the purpose in the metrics, a plural in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Purpose::Session => "sessions",
            Purpose::Change => "changes",
            Purpose::Frames => "frames",
            Purpose::Records => "records",
            Purpose::Commands => "commands",
            Purpose::Textures => "textures",
            Purpose::Connections => "connections",
            Purpose::Laws => "laws",
            Purpose::Meshes => "meshes",
            Purpose::Journals => "journals",
            Purpose::Requests => "requests",
        }
    }
}

/// A resource that an account can take from its budget. Each has its own pool; all memory is one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resource {
    /// Memory for a purpose, bytes (`limits.memory_bytes`).
    Memory(Purpose),
    /// Sessions, charged to the account that created them (`limits.sessions`).
    Sessions,
    /// Streams, charged to the account that reads them (`limits.streams`).
    Streams,
    /// Tools that are held, charged to the account of the holder (`limits.leases`).
    Leases,
}

impl Resource {
    /// Returns the index of its pool.
    fn index(self) -> usize {
        match self {
            Resource::Memory(_) => 0,
            Resource::Sessions => 1,
            Resource::Streams => 2,
            Resource::Leases => 3,
        }
    }

    /// Returns whether it is memory that is allocated when it is taken. The memory of a connection is what its
    /// window allows, which few connections use up.
    fn is_laid_out(self) -> bool {
        matches!(self, Resource::Memory(purpose) if purpose != Purpose::Connections)
    }

    /// Returns the unit for messages, and the key of the configuration that limits it.
    fn words(self) -> (&'static str, &'static str) {
        match self {
            Resource::Memory(_) => ("bytes", "limits.memory_bytes"),
            Resource::Sessions => ("sessions", "limits.sessions"),
            Resource::Streams => ("streams", "limits.streams"),
            Resource::Leases => ("tools", "limits.leases"),
        }
    }
}

/// A limited amount of one resource, and how much of it each account has. An account is a number.
#[derive(Debug, Default)]
pub struct Pool {
    most: u64,
    /// The amount that a single account must leave to others.
    reserve: u64,
    taken: u64,
    /// Amounts by number of account; accounts without any are left out.
    by: BTreeMap<u64, u64>,
}

impl Pool {
    /// Creates a pool of `most`. A single account must leave the part 1/`reserve` of it, rounded down (nothing if
    /// `most` is below `reserve`). `reserve` must not be 0.
    pub fn new(most: u64, reserve: u64) -> Self {
        Pool { most, reserve: most / reserve, ..Pool::default() }
    }

    /// Returns the most that one account can ever have.
    fn most_each(&self) -> u64 {
        self.most - self.reserve
    }

    fn fits(&self, own: u64, taken: u64) -> bool {
        let left = u128::from(self.most.saturating_sub(taken));
        taken <= self.most && u128::from(own) * u128::from(self.reserve) <= u128::from(self.most_each()) * left
    }

    /// Takes `amount` for `account`. Returns false, and takes nothing, if that is beyond the account's part: with r =
    /// 1/`reserve`, its amount may be at most (1 − r)/r of the rest that nobody has. Taking 0 tells whether it is
    /// within its part.
    pub fn take(&mut self, account: u64, amount: u64) -> bool {
        let own = self.of(account).saturating_add(amount);
        let fits = self.fits(own, self.taken.saturating_add(amount));
        if fits && amount > 0 {
            self.taken += amount;
            self.by.insert(account, own);
        }
        fits
    }

    /// Gives back `amount` of `account`. More than the account has must not be given back.
    pub fn give_back(&mut self, account: u64, amount: u64) {
        self.taken = self.taken.saturating_sub(amount);
        if let Some(own) = self.by.get_mut(&account) {
            *own = own.saturating_sub(amount);
            if *own == 0 {
                self.by.remove(&account);
            }
        }
    }

    /// Returns the amount that `account` has; 0 for an unknown one.
    pub fn of(&self, account: u64) -> u64 {
        self.by.get(&account).copied().unwrap_or(0)
    }

    /// Returns the amount that all accounts have together.
    pub fn taken(&self) -> u64 {
        self.taken
    }
}

/// The shared resources of a server, divided among the accounts of its callers by the rule of this module.
#[derive(Debug)]
pub struct Budget {
    /// By [`Resource::index`].
    pools: [Mutex<Pool>; 4],
    /// Bytes taken, by [`Purpose`].
    purposes: Mutex<[u64; Purpose::ALL.len()]>,
    times: Mutex<[RecentTime; Work::ALL.len()]>,
    accounts: Mutex<Accounts>,
}

/// Number of accounts above which accounts without users are forgotten. Until then their spent time is remembered.
const MAX_FORMER: usize = 4096;

#[derive(Debug, Default)]
struct Accounts {
    numbers: u64,
    /// A number outlives its account, so that spent time stays known.
    known: BTreeMap<String, (u64, Weak<Owner>)>,
}

impl Budget {
    /// Creates the budget of a server with `limits`, and with `stepping` stepping threads and `network` network
    /// threads, whose time it divides (0 counts as 1). If `limits.memory_bytes` is 0, memory is half of the
    /// machine's. A single caller must leave 1/4 of the memory, 1/64 of the sessions, and 1/16 of the streams and
    /// leases.
    #[allow(clippy::cast_precision_loss)]
    pub fn new(limits: &Limits, stepping: usize, network: usize) -> Arc<Self> {
        let bytes = if limits.memory_bytes > 0 { limits.memory_bytes } else { half_of_the_machine() };
        let pools = [
            Pool::new(bytes, 4),
            // Without tokens an address is one caller, which gets nearly everything.
            Pool::new(limits.sessions as u64, 64),
            Pool::new(limits.streams as u64, 16),
            Pool::new(limits.leases as u64, 16),
        ];
        let threads = [stepping, network].map(|threads| threads.max(1) as f64);
        // If there are fewer cores than threads, the threads share them.
        let cores = (machine::cores() / threads.iter().sum::<f64>()).min(1.0);
        let times = Work::ALL.map(|work| match work {
            Work::Reading => RecentTime::new(cores * threads[0]),
            Work::Network => RecentTime::new(cores * threads[1]),
        });
        Arc::new(Budget {
            pools: pools.map(Mutex::new),
            purposes: Mutex::default(),
            times: Mutex::new(times),
            accounts: Mutex::default(),
        })
    }

    /// Returns the account of the caller of that name, and creates it if it is unknown. Repeated calls return the
    /// same account while it is in use; afterwards its number and recent time are remembered for some thousand
    /// accounts.
    pub fn account(self: &Arc<Self>, name: &str) -> Account {
        let mut accounts = lock(&self.accounts);
        let known = accounts.known.get(name).map(|(number, owner)| (*number, owner.upgrade()));
        if let Some((_, Some(owner))) = known {
            return Account(owner);
        }
        let number = known.map_or(accounts.numbers + 1, |known| known.0);
        accounts.numbers = accounts.numbers.max(number);
        let owner = Arc::new(Owner {
            name: name.to_owned(),
            number,
            budget: self.clone(),
            turn: tokio::sync::Mutex::default(),
        });
        if accounts.known.len() > MAX_FORMER {
            accounts.known.retain(|_, (_, owner)| owner.strong_count() > 0);
        }
        accounts.known.insert(name.to_owned(), (number, Arc::downgrade(&owner)));
        Account(owner)
    }

    /// Returns the accounts that are in use, sorted by name.
    pub fn accounts(&self) -> Vec<Account> {
        lock(&self.accounts).known.values().filter_map(|(_, owner)| owner.upgrade()).map(Account).collect()
    }

    /// Returns the amount of a resource that all accounts have together; for memory, the bytes over all purposes.
    pub fn taken(&self, resource: Resource) -> u64 {
        lock(&self.pools[resource.index()]).taken()
    }

    /// Returns the bytes that all accounts have taken for one purpose.
    pub fn bytes_for(&self, purpose: Purpose) -> u64 {
        lock(&self.purposes)[purpose as usize]
    }

    /// Returns the bytes that all accounts have taken, over all purposes.
    pub fn bytes_taken(&self) -> u64 {
        self.taken(Resource::Memory(Purpose::Session))
    }

    /// Returns the bytes that can be taken in all: `limits.memory_bytes`, or half of the machine's memory.
    pub fn bytes(&self) -> u64 {
        lock(&self.pools[0]).most
    }
}

#[derive(Debug)]
struct Owner {
    name: String,
    number: u64,
    budget: Arc<Budget>,
    turn: tokio::sync::Mutex<()>,
}

/// Account of a caller, to which everything that it takes is charged. Clones are the same account; it is in use while
/// one exists.
#[derive(Debug, Clone)]
pub struct Account(Arc<Owner>);

impl Account {
    /// Creates an account `alone` with a budget of its own and practically no limit of memory, for work outside a
    /// server. Other resources have their default limits.
    pub fn alone() -> Self {
        Budget::new(&Limits { memory_bytes: u64::MAX / 4, ..Limits::default() }, 1, 1).account("alone")
    }

    /// Returns the name of the caller.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Returns the number of the account, from 1, which no other account of the budget has.
    pub fn number(&self) -> u64 {
        self.0.number
    }

    /// Returns the budget to which the account belongs.
    pub fn budget(&self) -> &Arc<Budget> {
        &self.0.budget
    }

    /// Returns the amount of a resource that the account has; for memory, the bytes over all purposes.
    pub fn has(&self, resource: Resource) -> u64 {
        lock(&self.0.budget.pools[resource.index()]).of(self.0.number)
    }

    /// Takes `amount` of a resource until the returned value is dropped. `field` is the field of the request that a
    /// refusal names; it may be empty.
    ///
    /// # Errors
    /// - [`Reason::TooLarge`]: `amount` is more than one account can ever have.
    /// - [`Reason::Overloaded`] for memory, [`Reason::TooMany`] for others: `amount` is beyond this account's part of
    ///   what is left.
    /// - The system does not have the memory. For [`Purpose::Connections`] this is not checked.
    pub fn take(&self, resource: Resource, amount: u64, field: &str) -> Result<Taken> {
        let mut taken = Taken { account: self.clone(), resource, amount: 0 };
        taken.grow_to(amount, field)?;
        Ok(taken)
    }

    /// Charges the account for a request that took `took_ns` of processor time and ended at `now_ns`, ns of a
    /// monotonic clock.
    pub fn spend(&self, work: Work, now_ns: u64, took_ns: u64) {
        lock(&self.0.budget.times)[work as usize].add(self.0.number, now_ns, took_ns);
    }

    /// Waits for and reserves the account's turn, so that its calls begin one after another: the next call begins
    /// when all that this one takes is known. Dropping the guard ends the turn. A task must not ask for it twice.
    pub async fn turn(&self) -> tokio::sync::MutexGuard<'_, ()> {
        self.0.turn.lock().await
    }

    /// Returns how long the account must wait at `now_ns`, ns, until its recent time is within its part of such work
    /// again; 0 if it need not wait, or took no time recently. A single caller gets half of the threads' time.
    pub fn must_wait_ns(&self, work: Work, now_ns: u64) -> u64 {
        lock(&self.0.budget.times)[work as usize].wait_ns(self.0.number, now_ns)
    }

    /// Returns the processor time of such work that the account took recently, as a fraction of a core. Older time
    /// fades with a time constant of 5 ms.
    pub fn share(&self, work: Work, now_ns: u64) -> f64 {
        lock(&self.0.budget.times)[work as usize].share(self.0.number, now_ns)
    }
}

/// An amount of a resource that an account has taken ([`Account::take`]). Dropping it gives the amount back.
#[derive(Debug)]
pub struct Taken {
    account: Account,
    resource: Resource,
    amount: u64,
}

impl Taken {
    /// Returns the amount that is taken now, in the unit of the resource.
    pub fn amount(&self) -> u64 {
        self.amount
    }

    /// Returns the account that is charged.
    pub fn account(&self) -> &Account {
        &self.account
    }

    /// Takes more, so that the amount is `amount`; an `amount` that is not larger changes nothing. Memory that is
    /// allocated at once must be available in the system. `field` is the field that a refusal names.
    ///
    /// # Errors
    /// Returns the refusals of [`Account::take`], for the difference. The amount then stays as it was.
    pub fn grow_to(&mut self, amount: u64, field: &str) -> Result<()> {
        let more = amount.saturating_sub(self.amount);
        if more == 0 {
            return Ok(());
        }
        if self.resource.is_laid_out() && more <= self.account.0.budget.bytes() {
            memory::check(more, "this request").map_err(|refusal| refusal.within(field))?;
        }
        let (budget, number) = (&self.account.0.budget, self.account.0.number);
        let mut pool = lock(&budget.pools[self.resource.index()]);
        if !pool.take(number, more) {
            return Err(refused(self.resource, &pool, number, more, field));
        }
        drop(pool);
        self.amount = amount;
        if let Resource::Memory(purpose) = self.resource {
            lock(&budget.purposes)[purpose as usize] += more;
        }
        Ok(())
    }

    /// Gives back what exceeds `amount`; a larger `amount` changes nothing.
    pub fn shrink_to(&mut self, amount: u64) {
        let less = self.amount.saturating_sub(amount);
        if less == 0 {
            return;
        }
        let budget = &self.account.0.budget;
        lock(&budget.pools[self.resource.index()]).give_back(self.account.0.number, less);
        if let Resource::Memory(purpose) = self.resource {
            lock(&budget.purposes)[purpose as usize] -= less;
        }
        self.amount -= less;
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.shrink_to(0);
    }
}

fn refused(resource: Resource, pool: &Pool, account: u64, more: u64, field: &str) -> Refusal {
    let (what, key) = resource.words();
    let (most, most_each, own) = (pool.most, pool.most_each(), pool.of(account));
    if more > most_each {
        let message = format!("would take {more} {what}, above the {most_each} that one caller may have ({key})");
        return Refusal::new(Reason::TooLarge, field, message);
    }
    let message = format!(
        "would take {more} {what} more: of the {most} that the server has ({key}), this caller has {own} and others {}; \
         no caller gets more than a part of what is left",
        pool.taken - own
    );
    let reason = if matches!(resource, Resource::Memory(_)) { Reason::Overloaded } else { Reason::TooMany };
    Refusal::new(reason, field, message)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn budget(bytes: u64) -> Arc<Budget> {
        Budget::new(&Limits { memory_bytes: bytes, sessions: 128, ..Limits::default() }, 1, 1)
    }

    const MEMORY: Resource = Resource::Memory(Purpose::Session);

    #[test]
    fn one_alone_gets_all_but_the_reserve_and_everybody_gets_something() {
        let budget = budget(1000);
        let greedy = budget.account("greedy");
        let fill = |account: &Account| std::iter::from_fn(|| account.take(MEMORY, 1, "").ok()).collect::<Vec<_>>();
        let first = fill(&greedy);
        assert_eq!(first.len(), 750);
        // A later caller finds three quarters of what was left, and the next one three quarters of the rest.
        let (second, third) = (fill(&budget.account("b")), fill(&budget.account("c")));
        assert_eq!((second.len(), third.len()), (187, 47));
        let refused = greedy.take(MEMORY, 1, "scene").unwrap_err();
        assert_eq!((refused.reason, refused.field.as_str()), (Reason::Overloaded, "scene"));
        assert_eq!(greedy.take(MEMORY, 751, "").unwrap_err().reason, Reason::TooLarge);
        drop(first);
        assert_eq!(budget.taken(MEMORY), 187 + 47);
        drop((second, third));
        assert_eq!((budget.taken(MEMORY), budget.bytes_for(Purpose::Session)), (0, 0));
    }

    #[test]
    fn two_who_want_all_get_the_same() {
        let budget = budget(7000);
        let (a, b) = (budget.account("a"), budget.account("b"));
        let mut kept = Vec::new();
        while let (Ok(one), Ok(other)) = (a.take(MEMORY, 1, ""), b.take(MEMORY, 1, "")) {
            kept.extend([one, other]);
        }
        assert_eq!((a.has(MEMORY), b.has(MEMORY)), (3000, 3000));
    }

    #[test]
    fn an_amount_grows_and_shrinks_and_a_refusal_leaves_it() {
        let budget = budget(1000);
        let account = budget.account("a");
        let mut taken = account.take(Resource::Memory(Purpose::Commands), 100, "").unwrap();
        taken.grow_to(700, "").unwrap();
        assert_eq!(taken.grow_to(800, "").unwrap_err().reason, Reason::Overloaded);
        assert_eq!((taken.amount(), budget.bytes_for(Purpose::Commands)), (700, 700));
        taken.shrink_to(10);
        assert_eq!(account.has(MEMORY), 10);
        drop(taken);
        assert_eq!(account.has(MEMORY), 0);
        assert!(account.take(MEMORY, u64::MAX, "").is_err());
    }

    #[test]
    fn few_are_not_parted_and_an_account_is_one_until_nobody_has_it() {
        let few = Budget::new(&Limits { sessions: 3, ..Limits::default() }, 1, 1);
        let account = few.account("a");
        let all: Vec<_> = (0..3).map(|_| account.take(Resource::Sessions, 1, "").unwrap()).collect();
        assert_eq!(account.take(Resource::Sessions, 1, "").unwrap_err().reason, Reason::TooMany);
        assert_eq!(few.account("a").number(), account.number());
        drop(account);
        assert_eq!(few.accounts().len(), 1);
        drop(all);
        assert!(few.accounts().is_empty());
    }
}
