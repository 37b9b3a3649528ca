//! Sending of messages.

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, Mac};
use reqwest::header::{CONTENT_TYPE, USER_AGENT};
use sha2::Sha256;

use crate::file::Hook;
use crate::message::Message;

/// Time for a receiver to answer.
const PATIENCE: Duration = Duration::from_secs(15);

/// A message that was not delivered, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Undelivered(pub String);

/// The HTTP client of all hooks.
#[derive(Debug, Clone)]
pub struct Client(reqwest::Client);

impl Client {
    /// # Errors
    /// The system gives no client, for example because it has no certificates.
    pub fn new() -> Result<Self, Undelivered> {
        access::tls::install_provider();
        let client = reqwest::Client::builder()
            .timeout(PATIENCE)
            // Only listed addresses get messages, so a receiver cannot send them elsewhere.
            .redirect(reqwest::redirect::Policy::none())
            .build();
        client.map(Self).map_err(|error| Undelivered(access::explain(&error)))
    }

    /// Sends `message` once, signed at `now_s`, in seconds since 1970.
    ///
    /// # Errors
    /// The receiver did not answer in time, or with another status than 2xx.
    pub async fn post(&self, hook: &Hook, message: &Message, now_s: u64) -> Result<(), Undelivered> {
        let request = self.0.post(hook.url.clone());
        let request = request.header(CONTENT_TYPE, "application/json").header(USER_AGENT, "stride");
        let request = request.header("webhook-id", &message.id).header("webhook-timestamp", now_s.to_string());
        let request = request.header("webhook-signature", signature(hook.secret(), message, now_s));
        let answer = request.body(message.body.clone()).send().await;
        // Without the address, which may be a secret itself.
        let answer = answer.map_err(|error| Undelivered(access::explain(&error.without_url())))?;
        match answer.status() {
            status if status.is_success() => Ok(()),
            status if status.is_redirection() => {
                Err(Undelivered(format!("it answered {status}, and redirects are not followed")))
            }
            status => Err(Undelivered(format!("it answered {status}"))),
        }
    }
}

/// `v1,` and the HMAC-SHA256 of id, time and body, joined by full stops, in base64.
fn signature(secret: &[u8], message: &Message, now_s: u64) -> String {
    let mut mac = Hmac::<Sha256>::new_from_slice(secret).expect("every length of key is taken");
    mac.update(format!("{}.{now_s}.{}", message.id, message.body).as_bytes());
    format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Topic;

    /// The example of the specification's reference libraries.
    #[test]
    fn signatures_are_those_of_standard_webhooks() {
        let secret = STANDARD.decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").expect("base64");
        let message = Message {
            topic: Topic::Failed,
            id: "msg_p5jXN8AQM9LWM0D4loKWxJek".to_owned(),
            body: r#"{"test": 2432232314}"#.to_owned(),
        };
        let expected = "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=";
        assert_eq!(signature(&secret, &message, 1_614_265_330), expected);
    }
}
