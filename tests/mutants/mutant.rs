
// What `run.py` adds to src/lib.rs of a copy of the tree.
#[allow(missing_docs)]
static MUTANT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
// Runs before `main`: a test is not asked for its mutant, it has it.
#[allow(unsafe_code)]
#[used]
#[unsafe(link_section = ".init_array")]
static INIT: extern "C" fn() = {
    extern "C" fn init() {
        if let Ok(text) = std::env::var("PALPATE_MUTANT") {
            MUTANT.store(text.parse().unwrap_or(0), std::sync::atomic::Ordering::Relaxed);
        }
    }
    init
};
/// Whether the mutant is on.
#[inline(always)]
pub fn mutant(id: u32) -> bool {
    MUTANT.load(std::sync::atomic::Ordering::Relaxed) == id
}
