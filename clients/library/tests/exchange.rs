//! What the network and the tick share, in every order in which two threads can get at it.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

/// Of loom, which runs a test once for each order.
mod sync {
    pub(crate) use loom::cell::UnsafeCell;
    pub(crate) use loom::sync::Arc;
    pub(crate) use loom::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
}

#[path = "../src/exchange.rs"]
mod exchange;

use loom::thread;

#[test]
fn a_queue_gives_what_it_was_given_in_order_and_drops_the_rest() {
    loom::model(|| {
        let whole = loom::sync::Arc::new(());
        let (mut writer, mut reader) = exchange::queue(2);
        let given = whole.clone();
        let writing = thread::spawn(move || {
            let mut refused = 0;
            for number in 0..3 {
                refused += usize::from(writer.push((number, given.clone())).is_err());
            }
            refused
        });
        let mut got = Vec::new();
        for _ in 0..2 {
            got.extend(reader.pop().map(|value| value.0));
            thread::yield_now();
        }
        let refused = writing.join().unwrap();
        assert!(reader.is_over(), "the writer is gone");
        while let Some(value) = reader.pop() {
            got.push(value.0);
        }
        assert!(got.is_sorted() && got.len() + refused == 3, "{got:?}, {refused} refused");
        drop(reader);
        // loom tells of a value that nobody dropped.
        drop(whole);
    });
}

#[test]
fn a_full_queue_has_room_again_when_something_was_read() {
    loom::model(|| {
        let (mut writer, mut reader) = exchange::queue(1);
        writer.push(1).unwrap();
        assert_eq!((writer.room(), writer.push(2)), (0, Err(2)));
        let reading = thread::spawn(move || (reader.pop(), reader));
        let pushed = writer.push(3).is_ok();
        let (first, mut reader) = reading.join().unwrap();
        assert_eq!((first, reader.pop()), (Some(1), pushed.then_some(3)));
        drop(reader);
        assert!(writer.is_over());
    });
}

#[test]
fn the_newest_value_is_whole_and_never_older_than_one_before() {
    loom::model(|| {
        let (mut teller, mut listener) = exchange::newest([0_u32; 2]);
        let telling = thread::spawn(move || {
            for value in 1..=3 {
                teller.tell(|place| *place = [value; 2]);
            }
        });
        let mut before = 0;
        for _ in 0..2 {
            listener.refresh();
            let [a, b] = listener.read(|value| *value);
            assert!(a == b && a >= before, "{a}, {b} after {before}");
            before = a;
        }
        telling.join().unwrap();
        assert_eq!(listener.refresh(), before < 3);
        assert_eq!(listener.read(|value| *value), [3, 3]);
    });
}

/// A model comes after the law that it names: who sees the model finds the law in the queue.
#[test]
fn what_was_queued_before_the_newest_value_was_told_is_there_with_it() {
    loom::model(|| {
        let (mut laws, mut to_learn) = exchange::queue(4);
        let (mut teller, mut listener) = exchange::newest(0_usize);
        let network = thread::spawn(move || {
            for number in 1..=2 {
                laws.push(number).unwrap();
                teller.tell(|model| *model = number);
            }
        });
        // The order of a tick: the model first, then the laws.
        listener.refresh();
        let model = listener.read(|model| *model);
        let mut known = 0;
        while let Some(law) = to_learn.pop() {
            known = law;
        }
        assert!(known >= model, "model {model} of a law that is not known; {known} is");
        network.join().unwrap();
    });
}
