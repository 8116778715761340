//! Our log of messages on disk beside redb, on the same work: `cargo bench --bench store`.
//!
//! Bytes written are what the system counts for this process (`/proc/self/io`): whole blocks, as flash sees them. The folder
//! is `BENCH_FOLDER`, or the system's temporary one; on a file system in memory nothing is written and that column is empty.

#![expect(clippy::print_stdout, reason = "a benchmark prints")]
#![expect(clippy::unwrap_used, reason = "a benchmark stops where it cannot go on")]
#![expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "figures to be read by people")]

use std::path::Path;

use cangate::store::{Class, Entry, Files, Limits, Store, StoreSettings, Sync, Turn};
use cangate::time::Clock;
use redb::{Database, Durability, TableDefinition};
use uuid::Uuid;

const PAYLOAD: usize = 200;
const TABLE: TableDefinition<'_, u64, &str> = TableDefinition::new("messages");

/// Bytes that the system wrote to disks for this process.
fn written() -> u64 {
    let io = std::fs::read_to_string("/proc/self/io").unwrap();
    let line = io.lines().find_map(|line| line.strip_prefix("write_bytes: ")).unwrap();
    line.parse().unwrap()
}

fn measure(name: &str, messages: u64, batch: u64, work: impl FnOnce()) {
    let clock = Clock::start();
    let before = written();
    work();
    let seconds = clock.now().instant.as_micros() as f64 / 1e6;
    let bytes = (written() - before) as f64 / (messages * PAYLOAD as u64) as f64;
    println!(
        "{name:<22} {messages:>6} in commits of {batch:<3}  {seconds:>7.2} s  {bytes:>6.1} bytes written per byte"
    );
}

fn ours(folder: &Path, sync: Sync, messages: u64, batch: u64) {
    let memory = Limits { records: 1000, bytes: 1 << 20 };
    let boot = Uuid::from_u128(1);
    let settings = StoreSettings { bytes: 1 << 30, age: None, sync, memory, boot, fresh: Uuid::new_v4 };
    let clock = Clock::start();
    let mut store = Store::open(Files::new(folder), settings, clock.now());
    let body: std::sync::Arc<str> = "x".repeat(PAYLOAD).into();
    for first in (1..=messages).step_by(usize::try_from(batch).unwrap()) {
        let entry = |number| Entry { class: Class::Event, number, body: body.clone() };
        let append = (first..first + batch).map(entry).collect();
        let done = store.turn(clock.now(), Turn { append, ..Turn::default() });
        assert!(!done.report.state.is_fault(), "{}", done.report.reason);
    }
    store.close(clock.now());
}

fn redb(folder: &Path, messages: u64, batch: u64) {
    let database = Database::create(folder.join("redb")).unwrap();
    let body = "x".repeat(PAYLOAD);
    for first in (1..=messages).step_by(usize::try_from(batch).unwrap()) {
        let mut transaction = database.begin_write().unwrap();
        transaction.set_durability(Durability::Immediate).unwrap();
        {
            let mut table = transaction.open_table(TABLE).unwrap();
            for number in first..first + batch {
                table.insert(number, body.as_str()).unwrap();
            }
        }
        transaction.commit().unwrap();
    }
}

fn main() {
    let base = std::env::var_os("BENCH_FOLDER").map_or_else(std::env::temp_dir, Into::into);
    let folder = tempfile::tempdir_in(base).unwrap();
    let place = |name: &str| {
        let place = folder.path().join(name);
        std::fs::create_dir_all(&place).unwrap();
        place
    };
    println!("{PAYLOAD} bytes each, in {}", folder.path().display());
    for (messages, batch) in [(2_000, 1), (50_000, 100)] {
        measure("cangate, strict", messages, batch, || {
            ours(&place(&format!("strict{batch}")), Sync::Strict, messages, batch);
        });
        measure("cangate, balanced", messages, batch, || {
            ours(&place(&format!("balanced{batch}")), Sync::Balanced, messages, batch);
        });
        measure("redb", messages, batch, || redb(&place(&format!("redb{batch}")), messages, batch));
    }
}
