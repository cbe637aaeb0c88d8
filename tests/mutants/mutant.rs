// What `run.py` adds to src/lib.rs of a copy of the tree.
#[allow(missing_docs)]
static MUTANT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
// Instead of a mutant: the original, which writes down what mutants it would meet.
const RECORD: u32 = u32::MAX;
#[allow(missing_docs)]
static MET: [std::sync::atomic::AtomicBool; 1 << 16] = [const { std::sync::atomic::AtomicBool::new(false) }; 1 << 16];
#[allow(missing_docs)]
static MET_FILE: std::sync::OnceLock<std::fs::File> = std::sync::OnceLock::new();
// Runs before `main`: a test is not asked for its mutant, it has it.
#[allow(unsafe_code)]
#[used]
#[unsafe(link_section = ".init_array")]
static INIT: extern "C" fn() = {
    extern "C" fn init() {
        let mut chosen = std::env::var("PALPATE_MUTANT").ok().and_then(|text| text.parse().ok()).unwrap_or(0);
        if let Ok(path) = std::env::var("PALPATE_MET") {
            if let Ok(file) = std::fs::OpenOptions::new().append(true).create(true).open(path) {
                let _ = MET_FILE.set(file);
                chosen = RECORD;
            }
        }
        MUTANT.store(chosen, std::sync::atomic::Ordering::Relaxed);
    }
    init
};
/// Whether the mutant is on.
#[inline(always)]
pub fn mutant(id: u32) -> bool {
    let chosen = MUTANT.load(std::sync::atomic::Ordering::Relaxed);
    if chosen == RECORD {
        meet(id);
    }
    chosen == id
}
// Written at once: a server of a test may be killed.
#[cold]
#[inline(never)]
fn meet(id: u32) {
    let met = &MET[id as usize];
    if !met.load(std::sync::atomic::Ordering::Relaxed) && !met.swap(true, std::sync::atomic::Ordering::Relaxed) {
        if let Some(mut file) = MET_FILE.get() {
            let _ = std::io::Write::write_all(&mut file, format!("{id}\n").as_bytes());
        }
    }
}
