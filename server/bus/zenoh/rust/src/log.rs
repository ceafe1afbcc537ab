//! Forwards zenoh's warnings and errors to the caller, and counts failed handshakes.
//!
//! zenoh has no counter for a peer that connects and does not speak zenoh. It only writes one debug line for each, so
//! this file reads the lines of the two modules that write them.

use std::ffi::{c_char, c_void};
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

type LogFn = extern "C" fn(*mut c_void, bool, *const c_char, usize);

/// The modules whose debug lines report failed handshakes.
const ACCEPT: &str = "zenoh_transport::unicast::establishment::accept";
const MANAGER: &str = "zenoh_transport::unicast::manager";

/// The starts of warnings that are dropped. The first comes at every start and is about gateways between regions; we
/// configure none. The second comes for each peer that reaches us through several network interfaces. It is about
/// access rules that name an interface; ours name none.
const NOT_ABOUT_US: [&str; 2] = ["Gossip is disabled", "Transport returned multiple network interfaces"];

static FAILED_HANDSHAKES: AtomicU64 = AtomicU64::new(0);

struct Forward {
    function: LogFn,
    context: *mut c_void,
}
unsafe impl Send for Forward {}
unsafe impl Sync for Forward {}

#[derive(Default)]
struct Message(String);

/// Removes every " at FILE.rs:LINE." that zenoh appends to its errors and leaves the rest, which states the cause.
pub fn without_source_paths(message: &str) -> String {
    let mut cleaned = String::with_capacity(message.len());
    let mut rest = message;
    while let Some((before, after)) = rest.split_once(".rs:") {
        let digits = after.bytes().take_while(u8::is_ascii_digit).count();
        // The last " at " before the extension: a path may contain spaces, and so may the words before it.
        match (before.rfind(" at "), after[digits..].strip_prefix('.')) {
            (Some(end_of_cause), Some(after_place)) if digits > 0 => {
                cleaned.push_str(&before[..end_of_cause]);
                rest = after_place;
            }
            _ => {
                cleaned.push_str(before);
                cleaned.push_str(".rs:");
                rest = after;
            }
        }
    }
    cleaned.push_str(rest);
    cleaned
}

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}");
        }
    }
}

impl Subscriber for Forward {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event()
            && (*metadata.level() <= Level::WARN
                || (*metadata.level() == Level::DEBUG && [ACCEPT, MANAGER].contains(&metadata.target())))
    }

    fn event(&self, event: &Event<'_>) {
        let mut message = Message::default();
        event.record(&mut message);
        let level = *event.metadata().level();
        if NOT_ABOUT_US.iter().any(|start| message.0.starts_with(start)) {
            return;
        }
        if level <= Level::WARN {
            let text = without_source_paths(&message.0);
            (self.function)(self.context, level == Level::ERROR, text.as_ptr().cast(), text.len());
            return;
        }
        let failed = match event.metadata().target() {
            ACCEPT => !message.0.starts_with("New transport link accepted"),
            _ => message.0.starts_with("Failed to accept link before deadline"),
        };
        if failed {
            FAILED_HANDSHAKES.fetch_add(1, Ordering::Relaxed);
        }
    }

    // `enabled` refuses spans, so the functions below are never called.
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }
    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

/// # Safety
/// The caller must keep the contract in tensormass_zenoh.h.
#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_set_log(function: LogFn, context: *mut c_void) -> bool {
    tracing::subscriber::set_global_default(Forward { function, context }).is_ok()
}

#[no_mangle]
pub extern "C" fn tensormass_zenoh_failed_handshakes() -> u64 {
    FAILED_HANDSHAKES.load(Ordering::Relaxed)
}
