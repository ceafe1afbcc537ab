//! Defines the C functions that `tensormass_zenoh.h` declares and documents: the part of zenoh that tensormass uses.
//! This crate exists because the registries have no C++ package of zenoh.
//!
//! Every put uses congestion control `Drop`, because `Block` lets one stopped subscriber stall the publisher.

mod answers;
mod log;
mod peers;

use std::collections::HashMap;
use std::ffi::{c_char, c_void, CStr};
use std::net::TcpListener;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use base64::Engine;
use zenoh::bytes::ZBytes;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr};
use zenoh::pubsub::Subscriber as ZenohSubscriber;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{QueryTarget, Queryable};
use zenoh::{Config, Session as ZenohSession, Wait};

type Failure = Box<dyn std::error::Error + Send + Sync>;
type Retained = Mutex<HashMap<OwnedKeyExpr, ZBytes>>;
type MessageFn = extern "C" fn(*mut c_void, *const c_char, usize, *const u8, usize);

pub struct Session {
    session: ZenohSession,
    locator: String,
    retained: Arc<Retained>,
    answers: Arc<answers::Answers>,
    _server: Option<Queryable<()>>,
}

pub struct Subscriber(ZenohSubscriber<()>);

/// The caller's function and its first argument. The C side promises that both may be used from any thread.
#[derive(Clone, Copy)]
struct Callback {
    function: MessageFn,
    context: *mut c_void,
}
unsafe impl Send for Callback {}
unsafe impl Sync for Callback {}

impl Callback {
    fn call(&self, key: &str, payload: &ZBytes) {
        let bytes = payload.to_bytes();
        (self.function)(self.context, key.as_ptr().cast(), key.len(), bytes.as_ptr(), bytes.len());
    }
}

/// Replaces port 0 by a port that is free now. zenoh could choose one itself, but does not report it for loopback
/// addresses. Another process may take the port before zenoh does; `open` then tries again.
fn concrete_locator(locator: &str) -> Result<String, Failure> {
    let Some((protocol, host)) = locator.strip_suffix(":0").and_then(|address| address.split_once('/')) else {
        return Ok(locator.to_owned());
    };
    let port = TcpListener::bind(format!("{host}:0"))?.local_addr()?.port();
    Ok(format!("{protocol}/{host}:{port}"))
}

/// What a session asks for: `tensormass_zenoh_options` in the header, as text.
struct Options<'a> {
    listen: &'a str,
    connect: &'a str,
    serve: &'a str,
    accept: &'a str,
    access_control: &'a str,
    authority: &'a str,
    certificate: &'a str,
    private_key: &'a str,
    max_sessions: u32,
    max_message_bytes: u32,
    max_declarations: u32,
    max_declarations_of_all: u32,
    max_keys: u32,
    max_key_bytes: u32,
    max_requests: f64,
    max_requests_per_s: f64,
    shared_memory: bool,
}

/// zenoh's rules for peers of a session that serves `serve` and takes puts under `accept` only. Without them zenoh routes
/// what one peer puts, answers or declares to all others, so that a stranger could speak in our name.
fn access_control(serve: &str, accept: &str) -> String {
    let rule = |id: &str, permission: &str, flow: &str, messages: &[&str], key: &str| {
        serde_json::json!({
            "id": id, "permission": permission, "flows": [flow], "messages": messages, "key_exprs": [key],
        })
    };
    let rules = [
        rule("put", "allow", "ingress", &["put"], accept),
        rule("ask", "allow", "ingress", &["declare_subscriber", "query"], "**"),
        rule("answer", "allow", "egress", &["put", "reply", "declare_queryable"], serve),
        // A peer sends puts only to who has told that it takes them.
        rule("take", "allow", "egress", &["declare_subscriber"], accept),
        // What a peer puts is for us alone: it may hold a secret.
        rule("keep", "deny", "egress", &["put"], accept),
    ];
    let ids: Vec<&str> = rules.iter().filter_map(|rule| rule["id"].as_str()).collect();
    serde_json::json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "peers"}],
        "policies": [{"rules": ids, "subjects": ["peers"]}],
    })
    .to_string()
}

/// zenoh's configuration; empty addresses mean not to listen or not to connect.
fn configure(options: &Options, listen: &str) -> Result<Config, Failure> {
    let endpoints = |locator: &str| serde_json::json!(if locator.is_empty() { vec![] } else { vec![locator] }).to_string();
    let mut config = Config::default();
    let mut limits = vec![];
    if options.max_sessions > 0 {
        limits.push(("transport/unicast/max_sessions", options.max_sessions.to_string()));
    }
    if options.max_message_bytes > 0 {
        limits.push(("transport/link/rx/max_message_size", options.max_message_bytes.to_string()));
    }
    // Rules by keys replace those by `accept`. Nothing else does: a session that accepts puts has rules.
    if !options.access_control.is_empty() {
        limits.push(("access_control", options.access_control.to_owned()));
    } else if !options.accept.is_empty() {
        limits.push(("access_control", access_control(options.serve, options.accept)));
    }
    if !options.authority.is_empty() {
        let base64 = |pem: &str| serde_json::json!(base64::engine::general_purpose::STANDARD.encode(pem)).to_string();
        let [certificate, key] = if listen.is_empty() {
            ["transport/link/tls/connect_certificate_base64", "transport/link/tls/connect_private_key_base64"]
        } else {
            ["transport/link/tls/listen_certificate_base64", "transport/link/tls/listen_private_key_base64"]
        };
        limits.push(("transport/link/tls/root_ca_certificate_base64", base64(options.authority)));
        limits.push((certificate, base64(options.certificate)));
        limits.push((key, base64(options.private_key)));
        limits.push(("transport/link/tls/enable_mtls", "true".to_owned()));
        limits.push(("transport/link/tls/close_link_on_expiration", "true".to_owned()));
    }
    for (key, value) in &limits {
        // Without the value, which may be a private key.
        config.insert_json5(key, value).map_err(|error| format!("{key}: {error}"))?;
    }
    // No scouting and no gossip: sessions talk only to the addresses that the user configured.
    for (key, value) in [
        ("mode", if listen.is_empty() { "\"client\"" } else { "\"peer\"" }),
        ("listen/endpoints", &endpoints(listen)),
        ("connect/endpoints", &endpoints(options.connect)),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
        // [ms] until a peer that has not finished the handshake is disconnected.
        ("transport/unicast/accept_timeout", "3000"),
        // In batches of 64 KiB. A frame of 20,000 vertices takes four, so the default queue of two drops it on links
        // slower than loopback.
        ("transport/link/tx/queue/size/data", "16"),
        ("transport/shared_memory/enabled", if options.shared_memory { "true" } else { "false" }),
        // Replies do not use shared memory. zenoh 1.10 can lose them there under load, and a late joiner asks only once.
        ("transport/shared_memory/transport_optimization/messages", "[\"put\"]"),
    ] {
        config.insert_json5(key, value).map_err(|error| format!("{key} = {value}: {error}"))?;
    }
    Ok(config)
}

fn open(options: &Options) -> Result<Session, Failure> {
    let mut attempts = if options.listen.ends_with(":0") { 8 } else { 1 };
    let (session, locator) = loop {
        let locator = concrete_locator(options.listen)?;
        match zenoh::open(configure(options, &locator)?).wait() {
            Ok(session) => break (session, locator),
            // Another process may have taken the free port in between.
            Err(_) if attempts > 1 => attempts -= 1,
            Err(error) => return Err(error),
        }
    };
    if options.max_declarations > 0 {
        let limits = peers::Limits {
            of_one: options.max_declarations as usize,
            of_all: options.max_declarations_of_all as usize,
            keys: options.max_keys as usize,
            key_bytes: options.max_key_bytes as usize,
            requests: options.max_requests,
            requests_per_s: options.max_requests_per_s,
        };
        peers::watch(&session, limits)?;
    }
    let retained = Arc::new(Retained::default());
    let answers = Arc::new(answers::Answers::new(retained.clone()));
    let server = match options.serve {
        "" => None,
        key => {
            let answers = answers.clone();
            let queryable = session.declare_queryable(key).callback(move |query| answers.take(query)).wait()?;
            Some(queryable)
        }
    };
    Ok(Session { session, locator, retained, answers, _server: server })
}

/// # Safety
/// `text` must be null, which reads as "", or a string with a terminating zero.
unsafe fn text<'a>(text: *const c_char) -> Result<&'a str, Failure> {
    if text.is_null() {
        return Ok("");
    }
    Ok(unsafe { CStr::from_ptr(text) }.to_str()?)
}

/// # Safety
/// `data` must point to `size` bytes, unless `size` is 0.
unsafe fn bytes<'a>(data: *const u8, size: usize) -> &'a [u8] {
    if size == 0 {
        return &[];
    }
    unsafe { std::slice::from_raw_parts(data, size) }
}

/// # Safety
/// `data` must point to `size` bytes, unless `size` is 0.
unsafe fn key_expr<'a>(data: *const c_char, size: usize) -> Result<KeyExpr<'a>, Failure> {
    KeyExpr::try_from(std::str::from_utf8(unsafe { bytes(data.cast(), size) })?)
}

/// Writes as much of `message` as fits in `capacity`, including the terminating zero.
///
/// # Safety
/// `target` must point to `capacity` writable bytes, unless `capacity` is 0.
unsafe fn write_text(message: &str, target: *mut c_char, capacity: usize) {
    if capacity == 0 {
        return;
    }
    let size = message.len().min(capacity - 1);
    unsafe {
        std::ptr::copy_nonoverlapping(message.as_ptr(), target.cast(), size);
        *target.add(size) = 0;
    }
}

/// `tensormass_zenoh_options` of the header.
#[repr(C)]
pub struct RawOptions {
    listen: *const c_char,
    connect: *const c_char,
    serve: *const c_char,
    accept: *const c_char,
    access_control: *const c_char,
    authority: *const c_char,
    certificate: *const c_char,
    private_key: *const c_char,
    max_sessions: u32,
    max_message_bytes: u32,
    max_declarations: u32,
    max_declarations_of_all: u32,
    max_keys: u32,
    max_key_bytes: u32,
    max_requests: f64,
    max_requests_per_s: f64,
    shared_memory: bool,
}

/// # Safety
/// The caller must keep the contract in tensormass_zenoh.h. The same holds for every function below.
#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_open(
    options: *const RawOptions,
    error: *mut c_char,
    error_capacity: usize,
) -> *mut Session {
    let result = unsafe {
        (|| {
            let raw = &*options;
            open(&Options {
                listen: text(raw.listen)?,
                connect: text(raw.connect)?,
                serve: text(raw.serve)?,
                accept: text(raw.accept)?,
                access_control: text(raw.access_control)?,
                authority: text(raw.authority)?,
                certificate: text(raw.certificate)?,
                private_key: text(raw.private_key)?,
                max_sessions: raw.max_sessions,
                max_message_bytes: raw.max_message_bytes,
                max_declarations: raw.max_declarations,
                max_declarations_of_all: raw.max_declarations_of_all,
                max_keys: raw.max_keys,
                max_key_bytes: raw.max_key_bytes,
                max_requests: raw.max_requests,
                max_requests_per_s: raw.max_requests_per_s,
                shared_memory: raw.shared_memory,
            })
        })()
    };
    match result {
        Ok(session) => Box::into_raw(Box::new(session)),
        Err(failure) => {
            unsafe { write_text(&log::without_source_paths(&failure.to_string()), error, error_capacity) };
            std::ptr::null_mut()
        }
    }
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_close(session: *mut Session) {
    if session.is_null() {
        return;
    }
    let session = unsafe { Box::from_raw(session) };
    peers::forget(&session.session);
    let unanswered = session.answers.end();
    if let Err(error) = session.session.close().wait_callbacks().wait() {
        tracing::warn!("closing the session: {error}");
    }
    drop(unanswered);
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_locator(session: *const Session, locator: *mut c_char, capacity: usize) {
    unsafe { write_text(&(*session).locator, locator, capacity) };
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_put(
    session: *const Session,
    key: *const c_char,
    key_size: usize,
    payload: *const u8,
    size: usize,
    urgent: bool,
    full_queues: *mut u32,
) -> bool {
    let (session, key) = unsafe { (&*session, key_expr(key, key_size)) };
    let Ok(key) = key else { return false };
    log::take_full_queues();
    let done = session
        .session
        .put(key, unsafe { bytes(payload, size) })
        .congestion_control(CongestionControl::Drop)
        .priority(if urgent { Priority::RealTime } else { Priority::Data })
        .wait()
        .is_ok();
    if !full_queues.is_null() {
        unsafe { *full_queues = log::take_full_queues() };
    }
    done
}

#[no_mangle]
pub extern "C" fn tensormass_zenoh_sender() -> u64 {
    peers::sender()
}

#[no_mangle]
pub extern "C" fn tensormass_zenoh_end_sender() {
    peers::close_sender();
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_sender_name(name: *mut c_char, capacity: usize) {
    unsafe { write_text(&peers::sender_name(), name, capacity) };
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_retain(
    session: *const Session,
    key: *const c_char,
    key_size: usize,
    payload: *const u8,
    size: usize,
) -> bool {
    let (session, key) = unsafe { (&*session, key_expr(key, key_size)) };
    let Ok(key) = key else { return false };
    let payload = ZBytes::from(unsafe { bytes(payload, size) });
    session.retained.lock().unwrap().insert(key.into(), payload);
    true
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_forget(session: *const Session, key: *const c_char, key_size: usize) {
    let (session, key) = unsafe { (&*session, key_expr(key, key_size)) };
    if let Ok(key) = key {
        session.retained.lock().unwrap().remove(&OwnedKeyExpr::from(key));
    }
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_subscribe(
    session: *const Session,
    key: *const c_char,
    key_size: usize,
    function: MessageFn,
    context: *mut c_void,
) -> *mut Subscriber {
    let (session, key) = unsafe { (&*session, key_expr(key, key_size)) };
    let Ok(key) = key else { return std::ptr::null_mut() };
    let callback = Callback { function, context };
    let subscriber = session
        .session
        .declare_subscriber(key)
        .callback(move |sample| callback.call(sample.key_expr().as_str(), sample.payload()))
        .wait();
    match subscriber {
        Ok(subscriber) => Box::into_raw(Box::new(Subscriber(subscriber))),
        Err(_) => std::ptr::null_mut(),
    }
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_unsubscribe(subscriber: *mut Subscriber) {
    if subscriber.is_null() {
        return;
    }
    let subscriber = unsafe { Box::from_raw(subscriber) };
    if let Err(error) = subscriber.0.undeclare().wait_callbacks().wait() {
        tracing::warn!("ending a subscription: {error}");
    }
}

#[no_mangle]
pub unsafe extern "C" fn tensormass_zenoh_get(
    session: *const Session,
    key: *const c_char,
    key_size: usize,
    timeout_ms: u32,
    function: MessageFn,
    context: *mut c_void,
) -> usize {
    let (session, key) = unsafe { (&*session, key_expr(key, key_size)) };
    let Ok(key) = key else { return 0 };
    let callback = Callback { function, context };
    let replies = session
        .session
        .get(key)
        .target(QueryTarget::All)
        .timeout(Duration::from_millis(timeout_ms.into()))
        .wait();
    let Ok(replies) = replies else { return 0 };
    replies
        .iter()
        .filter_map(|reply| reply.into_result().ok())
        .inspect(|sample| callback.call(sample.key_expr().as_str(), sample.payload()))
        .count()
}
