//! zenoh's own log lines, and the handshakes that failed, handed to the caller.

use std::ffi::{c_char, c_void};
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

type LogFn = extern "C" fn(*mut c_void, bool, *const c_char, usize);

/// Who connects and does not speak zenoh shows only in these modules' log: one debug line for each.
const ACCEPT: &str = "zenoh_transport::unicast::establishment::accept";
const MANAGER: &str = "zenoh_transport::unicast::manager";

/// A warning at every start about gateways between regions, which this configuration has none of.
const ABOUT_GOSSIP: &str = "Gossip is disabled";

static FAILED_HANDSHAKES: AtomicU64 = AtomicU64::new(0);

struct Forward {
    function: LogFn,
    context: *mut c_void,
}
unsafe impl Send for Forward {}
unsafe impl Sync for Forward {}

#[derive(Default)]
struct Message(String);

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
        if message.0.starts_with(ABOUT_GOSSIP) {
            return;
        }
        if level <= Level::WARN {
            (self.function)(self.context, level == Level::ERROR, message.0.as_ptr().cast(), message.0.len());
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

    // Spans are not enabled.
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }
    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

/// # Safety
/// As declared in tensormass_zenoh.h.
#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_set_log(function: LogFn, context: *mut c_void) -> bool {
    tracing::subscriber::set_global_default(Forward { function, context }).is_ok()
}

#[no_mangle]
pub extern "C" fn tensormass_zenoh_failed_handshakes() -> u64 {
    FAILED_HANDSHAKES.load(Ordering::Relaxed)
}
