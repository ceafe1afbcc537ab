//! Forwards zenoh's warnings and errors to the caller, and counts what zenoh refuses and drops.
//!
//! zenoh has no counter for a peer that connects and does not speak zenoh, nor for messages that it drops. It only
//! writes a line for each, so this file reads the lines of the modules that write them, and the spans that `peers` needs.

use std::cell::Cell;
use std::ffi::{c_char, c_void};
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Event, Level, Metadata, Subscriber};

use crate::peers;

type LogFn = extern "C" fn(*mut c_void, bool, *const c_char, usize, *const c_char, usize);

/// The modules whose debug lines report failed handshakes.
const ACCEPT: &str = "zenoh_transport::unicast::establishment::accept";
const MANAGER: &str = "zenoh_transport::unicast::manager";

/// The module whose span holds the handling of a peer's message.
const DEMUX: &str = "zenoh::net::primitives::demux";
/// The modules whose spans are declarations of a peer.
const PUBSUB: &str = "zenoh::net::routing::dispatcher::pubsub";
const INTERESTS: &str = "zenoh::net::routing::dispatcher::interests";
/// The module whose span is a put of a peer.
const FACE: &str = "zenoh::net::routing::dispatcher::face";
/// The module whose debug lines tell of keys that are kept.
const RESOURCE: &str = "zenoh::net::routing::dispatcher::resource";
/// The modules whose trace lines tell of messages that are not let in, too long, or not sent.
const ACCESS: &str = "zenoh::net::routing::interceptor::access_control";
const RECEIVE: &str = "zenoh_transport::unicast::universal::rx";
const SEND: &str = "zenoh_transport::common::pipeline";

/// Bytes of a trace line that are read. What follows may be a whole message. A key may have fewer.
const READ_OF_TRACE: usize = 512;
/// Bytes of a key that are read, more than it may have.
const READ_OF_KEY: usize = 2048;

/// Ids of spans.
const MESSAGE: u64 = 1;
const OTHER: u64 = 2;

/// The starts of warnings that are dropped. The first comes at every start and is about gateways between regions; we
/// configure none. The second comes for each peer that reaches us through several network interfaces. It is about
/// access rules that name an interface; ours name none.
const NOT_ABOUT_US: [&str; 2] = ["Gossip is disabled", "Transport returned multiple network interfaces"];

static FAILED_HANDSHAKES: AtomicU64 = AtomicU64::new(0);
static NOT_ALLOWED: AtomicU64 = AtomicU64::new(0);
static TOO_LARGE: AtomicU64 = AtomicU64::new(0);
static TOO_MANY_DECLARATIONS: AtomicU64 = AtomicU64::new(0);

/// Lines that say nothing of interest, by the address of their metadata: each was read once. 0: a free place.
static NOISE: [AtomicUsize; 32] = [const { AtomicUsize::new(0) }; 32];

thread_local! {
    /// A message of the current peer was not let in.
    static DENIED: Cell<bool> = const { Cell::new(false) };
    /// The message of the current peer is a put, let in or not.
    static PUT: Cell<bool> = const { Cell::new(false) };
    /// zenoh works out what a peer will be allowed, and writes the same lines.
    static CACHING: Cell<bool> = const { Cell::new(false) };
    static FULL_QUEUES: Cell<u32> = const { Cell::new(0) };
}

/// Peers whose queue became full during the last put of this thread. zenoh tries a second time, and writes each twice.
pub fn take_full_queues() -> u32 {
    FULL_QUEUES.take().div_ceil(2)
}

fn address_of(metadata: &Metadata<'_>) -> usize {
    std::ptr::from_ref(metadata) as usize
}

fn is_noise(metadata: &Metadata<'_>) -> bool {
    NOISE.iter().any(|place| place.load(Ordering::Relaxed) == address_of(metadata))
}

fn add_noise(metadata: &Metadata<'_>) {
    let free = |place: &&AtomicUsize| {
        place.compare_exchange(0, address_of(metadata), Ordering::Relaxed, Ordering::Relaxed).is_ok()
    };
    let _ = NOISE.iter().find(free);
}

fn is_of_keys(metadata: &Metadata<'_>) -> bool {
    metadata.is_event() && *metadata.level() == Level::DEBUG && metadata.target() == RESOURCE
}

fn is_counted_trace(metadata: &Metadata<'_>) -> bool {
    metadata.is_event() && *metadata.level() == Level::TRACE && [ACCESS, RECEIVE, SEND].contains(&metadata.target())
}

struct Forward {
    function: LogFn,
    context: *mut c_void,
}
unsafe impl Send for Forward {}
unsafe impl Sync for Forward {}

#[derive(Default)]
struct Message(String);

/// The first READ_OF_KEY bytes of a line, and how many it has.
#[derive(Default)]
struct Line {
    start: String,
    bytes: usize,
}

impl Write for Line {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        self.bytes += text.len();
        let mut room = text.len().min(READ_OF_KEY.saturating_sub(self.start.len()));
        while !text.is_char_boundary(room) {
            room -= 1;
        }
        self.start.push_str(&text[..room]);
        Ok(())
    }
}

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            let _ = write!(self, "{value:?}");
        }
    }
}

/// The first READ_OF_TRACE bytes of a line.
#[derive(Default)]
struct Start(String);

impl Write for Start {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        // The error ends the formatting of what follows.
        if self.0.len() >= READ_OF_TRACE {
            return Err(std::fmt::Error);
        }
        self.0.push_str(text);
        Ok(())
    }
}

impl Visit for Start {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            let _ = write!(self, "{value:?}");
        }
    }
}

/// Fields of a span of `peers`.
#[derive(Default)]
struct Fields {
    peer: String,
    id: Option<u32>,
    mode: String,
}

impl Visit for Fields {
    fn record_u64(&mut self, field: &Field, value: u64) {
        if field.name() == "id" {
            self.id = u32::try_from(value).ok();
        }
    }
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        match field.name() {
            "src" => drop(write!(self.peer, "{value:?}")),
            "mode" => drop(write!(self.mode, "{value:?}")),
            "id" => self.id = format!("{value:?}").parse().ok(),
            _ => (),
        }
    }
}

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

impl Forward {
    /// who: the peer that was disconnected, in a line of ours; "" in zenoh's.
    fn write(&self, is_error: bool, who: &str, text: &str) {
        (self.function)(self.context, is_error, who.as_ptr().cast(), who.len(), text.as_ptr().cast(), text.len());
    }

    fn tell(&self, closed: Option<peers::Closed>) {
        let Some(closed) = closed else { return };
        TOO_MANY_DECLARATIONS.fetch_add(1, Ordering::Relaxed);
        self.write(false, &closed.who, closed.why);
    }

    fn note_key(&self, event: &Event<'_>) {
        const KEPT: &str = "Register resource ";
        const DROPPED: &str = "Unregister resource ";
        let mut line = Line::default();
        event.record(&mut line);
        if let Some(key) = line.start.strip_prefix(KEPT) {
            self.tell(peers::keep_key(key, line.bytes - KEPT.len()));
        } else if let Some(key) = line.start.strip_prefix(DROPPED) {
            peers::drop_key(key);
        }
    }

    fn read_trace(event: &Event<'_>) {
        let mut line = Start::default();
        event.record(&mut line);
        let line = line.0.as_str();
        let noise = match event.metadata().target() {
            ACCESS => {
                CACHING.set(CACHING.get() || line.starts_with("ACL ("));
                // "WHO is unauthorized to WHAT (ingress) on KEY": peers choose the key alone, which comes last.
                let refused = line.split_once(" is unauthorized to ").and_then(|(_, rest)| rest.split_once(" on "));
                if let Some((what, _)) = refused.filter(|(what, _)| what.ends_with("(ingress)") && !CACHING.get()) {
                    DENIED.set(true);
                    PUT.set(PUT.get() || what.starts_with("Put") || what.starts_with("Delete"));
                }
                // The last line of those that say what will be allowed.
                if refused.is_some_and(|(what, _)| what.starts_with("Declare Liveliness Subscriber")) {
                    CACHING.set(false);
                }
                // A key may hold these words, too.
                refused.is_none() && line.contains(" is authorized to ")
            }
            RECEIVE => {
                TOO_LARGE.fetch_add(line.starts_with("Defragmentation buffer full").into(), Ordering::Relaxed);
                line.starts_with("Received: ") || line.starts_with("Transport: ")
            }
            _ => {
                let full = line.starts_with("Zenoh message dropped because it's over the deadline");
                FULL_QUEUES.set(FULL_QUEUES.get() + u32::from(full));
                !full
            }
        };
        if noise {
            add_noise(event.metadata());
        }
    }

    fn note_declaration(&self, name: &str, fields: &Fields) {
        let Some(id) = fields.id else { return };
        let (kind, begins) = match name {
            "declare_subscriber" => (peers::Kind::Subscriber, true),
            "undeclare_subscriber" => (peers::Kind::Subscriber, false),
            _ if fields.mode == "Final" => (peers::Kind::Interest, false),
            // zenoh keeps no interest in the present alone.
            _ if fields.mode == "Current" => return,
            _ => (peers::Kind::Interest, true),
        };
        if begins {
            self.tell(peers::declare(kind, id));
        } else {
            peers::undeclare(kind, id);
        }
    }
}

impl Subscriber for Forward {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        let level = *metadata.level();
        if metadata.is_event() {
            return level <= Level::WARN
                || (level == Level::DEBUG && [ACCEPT, MANAGER].contains(&metadata.target()))
                || is_of_keys(metadata)
                || (is_counted_trace(metadata) && !is_noise(metadata));
        }
        match metadata.target() {
            // Neither event nor span: zenoh asks whether it should make the span.
            DEMUX => level == Level::DEBUG,
            PUBSUB => ["declare_subscriber", "undeclare_subscriber"].contains(&metadata.name()),
            INTERESTS => metadata.name() == "interest",
            FACE => !metadata.is_span() || metadata.name() == "send_push",
            _ => false,
        }
    }

    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        match self.enabled(metadata) {
            // Read once, and then perhaps noise.
            true if is_counted_trace(metadata) => Interest::sometimes(),
            true => Interest::always(),
            false => Interest::never(),
        }
    }

    fn event(&self, event: &Event<'_>) {
        let level = *event.metadata().level();
        if is_counted_trace(event.metadata()) {
            return Self::read_trace(event);
        }
        if is_of_keys(event.metadata()) {
            return self.note_key(event);
        }
        let mut message = Message::default();
        event.record(&mut message);
        if NOT_ABOUT_US.iter().any(|start| message.0.starts_with(start)) {
            return;
        }
        if level <= Level::WARN {
            return self.write(level == Level::ERROR, "", &without_source_paths(&message.0));
        }
        let failed = match event.metadata().target() {
            ACCEPT => !message.0.starts_with("New transport link accepted"),
            _ => message.0.starts_with("Failed to accept link before deadline"),
        };
        if failed {
            FAILED_HANDSHAKES.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn new_span(&self, span: &Attributes<'_>) -> Id {
        if span.metadata().target() == FACE {
            PUT.set(true);
            return Id::from_u64(OTHER);
        }
        let mut fields = Fields::default();
        span.record(&mut fields);
        if span.metadata().target() != DEMUX {
            self.note_declaration(span.metadata().name(), &fields);
            return Id::from_u64(OTHER);
        }
        // zenoh enters the span at once, on this thread.
        DENIED.set(false);
        CACHING.set(false);
        PUT.set(false);
        Id::from_u64(if peers::begin_message(&fields.peer) { MESSAGE } else { OTHER })
    }

    fn exit(&self, span: &Id) {
        if span.into_u64() == MESSAGE {
            NOT_ALLOWED.fetch_add(DENIED.take().into(), Ordering::Relaxed);
            self.tell(peers::end_message(PUT.take()));
        }
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
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

/// `tensormass_zenoh_refusals` of the header.
#[repr(C)]
pub struct Refusals {
    not_allowed: u64,
    too_large: u64,
    too_many_declarations: u64,
}

#[no_mangle]
pub extern "C" fn tensormass_zenoh_refused() -> Refusals {
    Refusals {
        not_allowed: NOT_ALLOWED.load(Ordering::Relaxed),
        too_large: TOO_LARGE.load(Ordering::Relaxed),
        too_many_declarations: TOO_MANY_DECLARATIONS.load(Ordering::Relaxed),
    }
}
