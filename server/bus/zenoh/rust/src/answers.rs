//! Answers of a session to gets of its retained messages, on threads of its own.
//!
//! An answer waits for room in the queue to its peer: zenoh gives a reply the congestion control of the get, which peers
//! choose, and a large topology must not be dropped. zenoh's own threads must not wait so. They are two, and also
//! take the poses of all peers:
//!
//!     zenoh's thread ── take ──> queue ──> a thread answers, one get of a sender at a time
//!
//! A thread ends when the queue has nothing for it. `peers` bounds what one peer may ask. zenoh also tells a peer that a
//! get has ended, and waits for it, so not even a get without an answer may end on zenoh's thread.

use std::collections::{HashSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard};

use zenoh::bytes::ZBytes;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr};
use zenoh::query::Query;
use zenoh::Wait;

use crate::{peers, Retained};

/// Senders that are answered at once: threads.
const MOST_THREADS: usize = 64;
/// Gets that wait. A further one ends at once.
const MOST_WAITING: usize = 65_536;

#[derive(Default)]
struct Queue {
    waiting: VecDeque<(u64, Query)>,
    answered: HashSet<u64>, // senders that a thread answers
    ended: bool,
}

pub struct Answers {
    retained: Arc<Retained>,
    queue: Mutex<Queue>,
}

impl Answers {
    pub fn new(retained: Arc<Retained>) -> Self {
        Self { retained, queue: Mutex::default() }
    }

    /// Answers a get of the peer whose message this thread handles.
    pub fn take(self: &Arc<Self>, query: Query) {
        let sender = peers::sender();
        if sender == 0 {
            return answer(&query, &self.retained); // nobody watches the peers of this session
        }
        let mut queue = self.lock();
        if queue.ended || queue.waiting.len() >= MOST_WAITING {
            return;
        }
        queue.waiting.push_back((sender, query));
        if queue.answered.contains(&sender) || queue.answered.len() >= MOST_THREADS {
            return;
        }
        queue.answered.insert(sender);
        drop(queue);
        let answers = self.clone();
        let thread = std::thread::Builder::new().name("zenoh-answer".to_owned());
        if thread.spawn(move || answers.run(sender)).is_err() {
            self.lock().answered.remove(&sender); // the get waits for the next one
        }
    }

    /// Answers no more. Returns what waits, to drop when the connections are closed: until then the end of a get waits
    /// for its peer.
    pub fn end(&self) -> VecDeque<(u64, Query)> {
        let mut queue = self.lock();
        queue.ended = true;
        std::mem::take(&mut queue.waiting)
    }

    fn run(&self, mut sender: u64) {
        while let Some(query) = self.next(&mut sender) {
            answer(&query, &self.retained);
        }
    }

    /// Returns the next get of this thread's sender, or of one that no thread answers.
    fn next(&self, sender: &mut u64) -> Option<Query> {
        let mut queue = self.lock();
        queue.answered.remove(sender);
        let at = queue.waiting.iter().position(|(each, _)| !queue.answered.contains(each))?;
        let (next, query) = queue.waiting.remove(at)?;
        queue.answered.insert(next);
        *sender = next;
        Some(query)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

/// Replies to a get with every retained message whose key it matches.
fn answer(query: &Query, retained: &Retained) {
    // Copies the messages and releases the lock first, because a reply may wait for the peer that asked.
    let matching: Vec<(OwnedKeyExpr, ZBytes)> = retained
        .lock()
        .unwrap()
        .iter()
        .filter(|(key, _)| query.key_expr().intersects(key))
        .map(|(key, payload)| (key.clone(), payload.clone()))
        .collect();
    for (key, payload) in matching {
        if let Err(error) = query.reply(KeyExpr::from(key), payload).wait() {
            tracing::warn!("a late joiner got no answer: {error}");
        }
    }
}
