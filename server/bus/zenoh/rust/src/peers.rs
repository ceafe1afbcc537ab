//! What the peers of a serving session do: who sends the message that a callback receives, and how much each declares.
//!
//! zenoh has no call for either. It tells of each connection before the first message comes over it. It opens a span for
//! each message of a peer, and within it one for each declaration, and writes a line for each key that it keeps. `log`
//! is told of them, on the thread that handles the message:
//!
//!     span "demux"                   begin_message: the peer is the sender until end_message
//!       span "declare_subscriber"    declare    \
//!       line "Register resource"     keep_key    > beyond a limit, the peer's connection is closed
//!       callback of a subscriber     sender() says who it is
//!     exit                           end_message: the same for what is not a put
//!
//! Without a receiver of the log, no span comes, and nothing is limited.

use std::cell::{Cell, RefCell};
use std::collections::hash_map::{DefaultHasher, RandomState};
use std::collections::{HashMap, HashSet};
use std::hash::{BuildHasher, Hash, Hasher};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::os::fd::{BorrowedFd, RawFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, Mutex, MutexGuard};
use std::time::Instant;

use zenoh::sample::SampleKind;
use zenoh::session::{Link, ZenohId};
use zenoh::{Session, Wait};

/// What a peer declares and zenoh keeps until the peer undeclares it or leaves.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    Subscriber,
    Interest,
}

/// What one peer may declare, and all together.
#[derive(Clone, Copy)]
pub struct Limits {
    pub of_one: usize,
    pub of_all: usize,
    /// Keys that zenoh keeps for a peer's declarations; all together have `of_all`. Bytes of a key.
    pub keys: usize,
    pub key_bytes: usize,
    /// Messages of a sender other than puts: so many at once, and so many a second after that.
    pub requests: f64,
    pub requests_per_s: f64,
}

/// Declarations that a connection may make in its whole life, in multiples of what it may have at once. zenoh keeps
/// every key that was declared under one number, and ignores an undeclaration that it does not understand, so what a
/// peer says that it has is not a bound.
const MOST_EVER: usize = 64;
/// Peers that are remembered before those without an open connection are forgotten.
const MOST_REMEMBERED: usize = 2048;

/// Numbers of senders without a certificate: one a connection.
static NEXT_SENDER: AtomicU64 = AtomicU64::new(1);
/// Set in the numbers of senders with a certificate: one a name.
const NAMED: u64 = 1 << 63;

/// The two ends of a connection: the daemon's and the peer's.
type Ends = (SocketAddr, SocketAddr);

struct Peer {
    session: ZenohId,
    sender: u64,
    /// The name of its certificate, or its address: for the log.
    who: String,
    // One, unless zenoh joins several of a peer.
    connections: Vec<Ends>,
    /// How many joined before it, and whether a span has named it.
    number: u64,
    is_bound: bool,
    limits: Limits,
    declared: HashSet<(Kind, u32)>,
    keys: HashSet<u64>, // their hashes
    ever: usize,
    closed: bool,
}

/// Messages that may come at once.
struct Budget {
    left: f64,
    since: Instant,
}

/// By the peer's id.
type Peers = HashMap<String, Peer>;
#[derive(Default)]
struct State {
    peers: Peers,
    /// A span has the first four bytes of a peer's id and a number, which no other peer gets. What that is in full: the
    /// first peer with such an id that no number was bound to. Peers choose their ids, and may choose like another. They
    /// share nothing, but whoever joined at the same moment may be taken for the other.
    faces: HashMap<String, String>,
    joined: u64,
    /// By the number of the sender: all connections of a certificate share one.
    budgets: HashMap<u64, Budget>,
}
static STATE: LazyLock<Mutex<State>> = LazyLock::new(Mutex::default);
static KEY_HASHES: LazyLock<RandomState> = LazyLock::new(RandomState::new);

/// Who was disconnected: one peer, or all of a sender.
pub struct Closed {
    pub who: String,
    pub why: &'static str,
}

thread_local! {
    static CURRENT: RefCell<String> = const { RefCell::new(String::new()) };
    static SENDER: Cell<u64> = const { Cell::new(0) };
}

fn lock() -> MutexGuard<'static, State> {
    STATE.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Limits what the peers of a session declare.
pub fn watch(session: &Session, limits: Limits) -> zenoh::Result<()> {
    let own = session.zid();
    session
        .info()
        .link_events_listener()
        .history(true)
        .callback(move |event| match event.kind() {
            SampleKind::Put => join(event.link(), own, limits),
            SampleKind::Delete => leave(event.link()),
        })
        .background()
        .wait()
}

/// Forgets the peers of a session that ends: zenoh drops its listeners before its connections.
pub fn forget(session: &Session) {
    let own = session.zid();
    let mut state = lock();
    state.peers.retain(|_, peer| peer.session != own);
    forget_left(&mut state);
}

/// Forgets the peers without an open connection: zenoh does not tell of every end.
fn forget_ended(peers: &mut Peers) {
    let open: HashSet<Ends> = connections().map(|(ends, _)| ends).collect();
    peers.retain(|_, peer| peer.connections.iter().any(|ends| open.contains(ends)));
}

/// Forgets the budgets of senders that left, and the faces of peers.
fn forget_left(state: &mut State) {
    let senders: HashSet<u64> = state.peers.values().map(|peer| peer.sender).collect();
    state.budgets.retain(|sender, _| senders.contains(sender));
    let peers = &state.peers;
    state.faces.retain(|_, id| peers.contains_key(id));
}

fn join(link: &Link, session: ZenohId, limits: Limits) {
    let Some(ends) = ends_of(link) else { return };
    let sender = match link.auth_identifier() {
        Some(name) => {
            let mut hasher = DefaultHasher::new();
            name.hash(&mut hasher);
            hasher.finish() | NAMED
        }
        None => NEXT_SENDER.fetch_add(1, Ordering::Relaxed),
    };
    let who = link.auth_identifier().as_ref().map_or_else(|| ends.1.to_string(), |name| name.to_string());
    let mut state = lock();
    if state.peers.len() >= MOST_REMEMBERED {
        forget_ended(&mut state.peers);
    }
    if state.budgets.len() >= MOST_REMEMBERED || state.faces.len() >= MOST_REMEMBERED {
        forget_left(&mut state);
    }
    state.joined += 1;
    let number = state.joined;
    state.budgets.entry(sender).or_insert_with(|| Budget { left: limits.requests, since: Instant::now() });
    let peer = state.peers.entry(link.zid().to_string()).or_insert_with(|| Peer {
        session,
        sender,
        who,
        connections: vec![],
        number,
        is_bound: false,
        limits,
        declared: HashSet::new(),
        keys: HashSet::new(),
        ever: 0,
        closed: false,
    });
    peer.closed = false;
    peer.is_bound = false; // it may have come back under another number
    if !peer.connections.contains(&ends) {
        peer.connections.push(ends);
    }
}

fn leave(link: &Link) {
    let Some(ends) = ends_of(link) else { return };
    let mut state = lock();
    let id = link.zid().to_string();
    if let Some(peer) = state.peers.get_mut(&id) {
        peer.connections.retain(|each| *each != ends);
        if peer.connections.is_empty() {
            state.peers.remove(&id);
            state.faces.retain(|_, each| *each != id);
        }
    }
}

fn ends_of(link: &Link) -> Option<Ends> {
    let address = |text: &str| text.parse::<SocketAddr>().ok();
    Some((address(link.src().address().as_str())?, address(link.dst().address().as_str())?))
}

/// The first four bytes of an id, as spans write them: in hexadecimal digits, without zeros before.
fn short(id: &str) -> &str {
    let bytes = id.len().div_ceil(2);
    &id[..id.len() - 2 * bytes.saturating_sub(4)]
}

/// Binds a face, START:NUMBER, to the first peer whose id starts so and that is not bound. Returns its id.
fn bind(state: &mut State, face: &str) -> Option<String> {
    let start = face.rsplit_once(':').map_or(face, |(start, _)| start);
    let fits = |(id, peer): &(&String, &mut Peer)| !peer.is_bound && short(id) == start;
    let (id, peer) = state.peers.iter_mut().filter(fits).min_by_key(|(_, peer)| peer.number)?;
    peer.is_bound = true;
    let id = id.clone();
    state.faces.insert(face.to_owned(), id.clone());
    Some(id)
}

/// A peer's message is handled on this thread from now on. source: the face of the message's span, REGION/START:NUMBER.
/// Returns false if the peer is not one of a serving session.
pub fn begin_message(source: &str) -> bool {
    let face = source.rsplit_once('/').map_or(source, |(_, rest)| rest);
    let mut state = lock();
    let id = match state.faces.get(face) {
        Some(id) => Some(id.clone()),
        None => bind(&mut state, face),
    };
    let sender = id.as_ref().and_then(|id| state.peers.get(id)).map_or(0, |peer| peer.sender);
    drop(state);
    SENDER.set(sender);
    if sender != 0 {
        CURRENT.set(id.unwrap_or_default());
    }
    sender != 0
}

/// was_put: the message was a put, which others count. Returns who was disconnected, if it was one too many.
pub fn end_message(was_put: bool) -> Option<Closed> {
    let sender = SENDER.take();
    if was_put || sender == 0 {
        return None;
    }
    let mut state = lock();
    let State { peers, budgets, .. } = &mut *state;
    let peer = CURRENT.with_borrow(|current| peers.get_mut(current))?;
    let (limits, now) = (peer.limits, Instant::now());
    let budget = budgets.entry(sender).or_insert_with(|| Budget { left: limits.requests, since: now });
    let gained = (now - budget.since).as_secs_f64() * limits.requests_per_s;
    budget.left = limits.requests.min(budget.left + gained);
    budget.since = now;
    if budget.left < 1.0 {
        return close(peer, "more declarations and queries than kMaxZenohRequestsAtOnce");
    }
    budget.left -= 1.0;
    None
}

/// Number of the peer whose message is handled on this thread; 0: none.
pub fn sender() -> u64 {
    SENDER.get()
}

/// Who that is, for the log; "": nobody.
pub fn sender_name() -> String {
    if sender() == 0 {
        return String::new();
    }
    let state = lock();
    CURRENT.with_borrow(|current| state.peers.get(current).map_or_else(String::new, |peer| peer.who.clone()))
}

/// Closes the connection of the peer whose message is handled on this thread. Whoever asks for it tells why.
pub fn close_sender() {
    if sender() == 0 {
        return;
    }
    let mut state = lock();
    if let Some(peer) = CURRENT.with_borrow(|current| state.peers.get_mut(current)) {
        let _ = close(peer, "");
    }
}

/// Notes a declaration of the current peer. Returns who was disconnected, if it was one too many: the current peer, or
/// the sender with most if all together have too many.
pub fn declare(kind: Kind, id: u32) -> Option<Closed> {
    note(|peer| {
        peer.declared.insert((kind, id));
        peer.ever += 1;
        let most = peer.limits.of_one;
        let too_many = peer.declared.len() > most || peer.ever > MOST_EVER * most;
        too_many.then_some("more subscriptions than kMaxZenohDeclarations")
    })
}

pub fn undeclare(kind: Kind, id: u32) {
    if sender() == 0 {
        return;
    }
    let mut state = lock();
    if let Some(peer) = CURRENT.with_borrow(|current| state.peers.get_mut(current)) {
        peer.declared.remove(&(kind, id));
    }
}

/// Notes a key of `bytes` bytes that zenoh keeps from now on, because the current peer declared it. key: its start, at
/// least as much of it as a key may have. Returns as `declare`.
pub fn keep_key(key: &str, bytes: usize) -> Option<Closed> {
    note(|peer| {
        if bytes > peer.limits.key_bytes {
            return Some("a key longer than kMaxZenohKeyBytes");
        }
        peer.keys.insert(KEY_HASHES.hash_one(key));
        (peer.keys.len() > peer.limits.keys).then_some("more keys than kMaxZenohKeys")
    })
}

/// zenoh keeps the key no more. Whoever ended its last use, the peer that declared it first has one less.
pub fn drop_key(key: &str) {
    let hash = KEY_HASHES.hash_one(key);
    let mut state = lock();
    if sender() != 0 && CURRENT.with_borrow(|current| state.peers.get_mut(current)).is_some_and(|p| p.keys.remove(&hash)) {
        return;
    }
    let _ = state.peers.values_mut().find_map(|peer| peer.keys.remove(&hash).then_some(()));
}

/// add: adds to what the current peer has, and returns why that is too much for one.
fn note(add: impl FnOnce(&mut Peer) -> Option<&'static str>) -> Option<Closed> {
    if sender() == 0 {
        return None;
    }
    let mut state = lock();
    let peers = &mut state.peers;
    let peer = CURRENT.with_borrow(|current| peers.get_mut(current))?;
    // A peer that is closed may have sent more before.
    if peer.closed {
        return None;
    }
    if let Some(why) = add(peer) {
        return close(peer, why);
    }
    let most = peer.limits.of_all;
    let too_many = |peers: &Peers| {
        peers.values().map(|peer| peer.declared.len()).sum::<usize>() > most
            || peers.values().map(|peer| peer.keys.len()).sum::<usize>() > most
    };
    if !too_many(peers) {
        return None;
    }
    forget_ended(peers);
    if !too_many(peers) {
        return None;
    }
    let mut of_senders: HashMap<u64, usize> = HashMap::new();
    for peer in peers.values() {
        *of_senders.entry(peer.sender).or_default() += peer.declared.len() + peer.keys.len();
    }
    // The sender, not the connection: a certificate may have many.
    let (&largest, _) = of_senders.iter().max_by_key(|(_, count)| **count)?;
    let why = "most of more subscriptions than kMaxZenohDeclarationsOfAll";
    peers.values_mut().filter(|peer| peer.sender == largest).filter_map(|peer| close(peer, why)).last()
}

/// zenoh has no call that closes one connection, but it notices the end of the stream.
fn close(peer: &mut Peer, why: &'static str) -> Option<Closed> {
    if peer.closed {
        return None;
    }
    peer.closed = true;
    peer.declared.clear();
    peer.keys.clear();
    for (ends, stream) in connections() {
        if peer.connections.contains(&ends) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
    Some(Closed { who: peer.who.clone(), why })
}

/// The open connections of this process.
fn connections() -> impl Iterator<Item = (Ends, TcpStream)> {
    let files = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let numbers: Vec<RawFd> = files.filter_map(|file| file.file_name().to_str()?.parse().ok()).collect();
    numbers.into_iter().filter_map(|number| {
        // SAFETY: the descriptor is copied before it is used. If it was closed meanwhile there is no copy, and whatever
        // has its number by then has other ends.
        let copy = unsafe { BorrowedFd::borrow_raw(number) }.try_clone_to_owned().ok()?;
        let stream = TcpStream::from(copy);
        Some(((stream.local_addr().ok()?, stream.peer_addr().ok()?), stream))
    })
}
