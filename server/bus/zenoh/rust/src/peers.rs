//! What the peers of a serving session do: who sends the message that a callback receives, and how much each declares.
//!
//! zenoh has no call for either. It tells of each connection before the first message comes over it. It opens a span for
//! each message of a peer, and within it one for each declaration. `log` is told of them, on the thread that handles the
//! message:
//!
//!     span "demux"                   begin_message: the peer is the sender until end_message
//!       span "declare_subscriber"    declare: beyond a limit, the peer's connection is closed
//!       callback of a subscriber     sender() says who it is
//!     exit                           end_message
//!
//! Without a receiver of the log, no span comes, and nothing is limited.

use std::cell::{Cell, RefCell};
use std::collections::hash_map::DefaultHasher;
use std::collections::{HashMap, HashSet};
use std::hash::{Hash, Hasher};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::os::fd::{BorrowedFd, RawFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, Mutex, MutexGuard};

use zenoh::sample::SampleKind;
use zenoh::session::{Link, ZenohId};
use zenoh::{Session, Wait};

/// What a peer declares and zenoh keeps until the peer undeclares it or leaves.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    Subscriber,
    Interest,
}

/// Declarations of one peer, and of all together.
#[derive(Clone, Copy)]
pub struct Limits {
    pub of_one: usize,
    pub of_all: usize,
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
    // One, unless peers have chosen ids that look the same in a span. They share what one may do.
    connections: Vec<Ends>,
    limits: Limits,
    declared: HashSet<(Kind, u32)>,
    ever: usize,
    closed: bool,
}

/// By the start of the peer's id, as spans write it.
type Peers = HashMap<String, Peer>;
static PEERS: LazyLock<Mutex<Peers>> = LazyLock::new(Mutex::default);

thread_local! {
    static CURRENT: RefCell<String> = const { RefCell::new(String::new()) };
    static SENDER: Cell<u64> = const { Cell::new(0) };
}

fn lock() -> MutexGuard<'static, Peers> {
    PEERS.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
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
    lock().retain(|_, peer| peer.session != own);
}

/// Forgets the peers without an open connection: zenoh does not tell of every end.
fn forget_ended(peers: &mut Peers) {
    let open: HashSet<Ends> = connections().map(|(ends, _)| ends).collect();
    peers.retain(|_, peer| peer.connections.iter().any(|ends| open.contains(ends)));
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
    let mut peers = lock();
    if peers.len() >= MOST_REMEMBERED {
        forget_ended(&mut peers);
    }
    let peer = peers.entry(short(link.zid())).or_insert_with(|| Peer {
        session,
        sender,
        connections: vec![],
        limits,
        declared: HashSet::new(),
        ever: 0,
        closed: false,
    });
    peer.closed = false;
    if !peer.connections.contains(&ends) {
        peer.connections.push(ends);
    }
}

fn leave(link: &Link) {
    let Some(ends) = ends_of(link) else { return };
    let mut peers = lock();
    let id = short(link.zid());
    if let Some(peer) = peers.get_mut(&id) {
        peer.connections.retain(|each| *each != ends);
        if peer.connections.is_empty() {
            peers.remove(&id);
        }
    }
}

fn ends_of(link: &Link) -> Option<Ends> {
    let address = |text: &str| text.parse::<SocketAddr>().ok();
    Some((address(link.src().address().as_str())?, address(link.dst().address().as_str())?))
}

/// The first four bytes of an id, as spans write them: in hexadecimal digits, without zeros before.
fn short(id: &ZenohId) -> String {
    let digits = id.to_string();
    let bytes = digits.len().div_ceil(2);
    digits[..digits.len() - 2 * bytes.saturating_sub(4)].to_owned()
}

/// A peer's message is handled on this thread from now on. source: the face of the message's span, REGION/ID:NUMBER.
/// Returns false if the peer is not one of a serving session.
pub fn begin_message(source: &str) -> bool {
    let id = source.rsplit_once('/').map_or(source, |(_, rest)| rest);
    let id = id.rsplit_once(':').map_or(id, |(id, _)| id);
    let sender = lock().get(id).map_or(0, |peer| peer.sender);
    SENDER.set(sender);
    if sender != 0 {
        CURRENT.with_borrow_mut(|current| {
            current.clear();
            current.push_str(id);
        });
    }
    sender != 0
}

pub fn end_message() {
    SENDER.set(0);
}

/// Number of the peer whose message is handled on this thread; 0: none.
pub fn sender() -> u64 {
    SENDER.get()
}

/// Notes a declaration of the current peer. Returns true if it was one too many and a connection was closed for it: that
/// of the current peer, or of the one with most if all together have too many.
pub fn declare(kind: Kind, id: u32) -> bool {
    if sender() == 0 {
        return false;
    }
    let mut peers = lock();
    let Some(peer) = CURRENT.with_borrow(|current| peers.get_mut(current)) else { return false };
    // A peer that is closed may have sent more before.
    if peer.closed {
        return false;
    }
    peer.declared.insert((kind, id));
    peer.ever += 1;
    let limits = peer.limits;
    if peer.declared.len() > limits.of_one || peer.ever > MOST_EVER * limits.of_one {
        close(peer);
        return true;
    }
    let all = |peers: &Peers| peers.values().map(|peer| peer.declared.len()).sum::<usize>();
    if all(&peers) <= limits.of_all {
        return false;
    }
    forget_ended(&mut peers);
    if all(&peers) <= limits.of_all {
        return false;
    }
    let mut of_senders: HashMap<u64, usize> = HashMap::new();
    for peer in peers.values() {
        *of_senders.entry(peer.sender).or_default() += peer.declared.len();
    }
    // The sender, not the connection: a certificate may have many.
    let Some((&largest, _)) = of_senders.iter().max_by_key(|(_, count)| **count) else { return false };
    peers.values_mut().filter(|peer| peer.sender == largest).for_each(close);
    true
}

pub fn undeclare(kind: Kind, id: u32) {
    if sender() == 0 {
        return;
    }
    let mut peers = lock();
    if let Some(peer) = CURRENT.with_borrow(|current| peers.get_mut(current)) {
        peer.declared.remove(&(kind, id));
    }
}

/// zenoh has no call that closes one connection, but it notices the end of the stream.
fn close(peer: &mut Peer) {
    peer.closed = true;
    peer.declared.clear();
    for (ends, stream) in connections() {
        if peer.connections.contains(&ends) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
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
